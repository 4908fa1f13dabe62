"""A setting at all points of a matrix: avoided, or at which speed it hits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from safevar_sumo.records import Outcome
from safevar_sumo.simulation import AtPoint, point_record
from safevar_sumo.terminal.plain import WholeTable, plain

KMH = 3.6
BANDS = ((5.0, "green"), (15.0, "yellow"), (25.0, "dark_orange"), (35.0, "orange4"))
"""Relative impact speed [km/h] below which a colour holds, red above: the bands of Euro NCAP's tests of AEB between cars."""
NAMED = 6
"""How many of the points that fail are named."""
ROW, COLUMN = "speed", "impact_location"


def print_matrix(console: Console, found: Sequence[AtPoint], row: int = 0) -> None:
    """A table for each test and weather, speed by impact location; what else varies has rows of its own."""
    records = [point_record(one, row) for one in found]
    tables: dict[tuple[str, str], list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for one, told in zip(found, records, strict=True):
        place = dict(one.point.place)
        tables.setdefault((place.pop("test"), place.pop("weather")), []).append((place, told))
    for (test, weather), points in tables.items():
        _print_table(console, f"{test}, {weather}", points)
    if records:
        hit = [told["point"] for told in records if told["impact_speed"] is not None]
        first = "; ".join(hit[:NAMED]) + (f" and {len(hit) - NAMED} more" if len(hit) > NAMED else "")
        summary = f"{len(hit)} of {len(records)} points fail{': ' + first if hit else ''}."
        invalid = sum(told["outcome"] == Outcome.INVALID_TEST for told in records)
        if invalid:
            summary += f" {invalid} are no valid tests: the vehicle leaves the tolerance of their speed before the ADS acts."
        console.print(summary, soft_wrap=True, markup=False, highlight=False)


def _print_table(console: Console, title: str, points: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    columns = list(dict.fromkeys(place.get(COLUMN) for place, _ in points))
    table = WholeTable(title=plain(title), title_justify="left")
    table.add_column("speed")
    for column in columns:
        table.add_column("" if column is None else f"{column:g} %", justify="right")
    cells: dict[str, dict[Any, Text]] = {}
    for place, told in points:
        cells.setdefault(_row(place), {})[place.get(COLUMN)] = _cell(told)
    for name, by_column in cells.items():
        table.add_row(plain(name), *(by_column.get(column, Text("")) for column in columns))
    console.print(table)


def _row(place: dict[str, Any]) -> str:
    speed = [f"{place[ROW]:g} km/h"] if ROW in place else []
    return ", ".join([*speed, *(f"{name} {value}" for name, value in place.items() if name not in (ROW, COLUMN))])


def _cell(told: dict[str, Any]) -> Text:
    if told["outcome"] == Outcome.INVALID_TEST:
        return Text(f"{told['outcome']} ({told['test_speed_error']:+.1f} km/h)", "magenta")
    if told["impact_speed"] is None:
        touched = f", {told['contact']['side']} side touched" if "contact" in told else ""
        return Text("avoided" + touched if told["outcome"] in (Outcome.STOPPED, Outcome.PASSED) else told["outcome"], "green")
    relative = (told["relative_impact_speed"] or 0.0) * KMH
    colour = next((colour for below, colour in BANDS if relative < below), "red")
    return Text(f"{told['impact_speed'] * KMH:.1f} km/h", colour)
