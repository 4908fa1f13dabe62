"""One simulation or a sweep of them, and lists of what there is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from safevar_sumo.api.simulation import Simulation
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.matrix import AtPoint, point_record
from safevar_sumo.terminal import WholeTable, plain, print_meanings
from safevar_sumo.vehicles import CharacteristicSet


def print_simulation(console: Console, found: Simulation) -> None:
    """A setting beside the original vehicle: what was simulated, how it ended, metrics and objectives, a verdict."""
    _print_setting(console, found)
    members = CharacteristicSet.of(found.study.vehicle.characteristics)
    print_meanings(console, [member for member in members if found.setting[member.name] != member.original])
    records = (found.original.record(), found.record())
    table = WholeTable()
    table.add_column("result")
    table.add_column("unit")
    for head in ("original", "simulated"):
        table.add_column(head, justify="right")
    table.add_row("outcome", "", *(record["outcome"] for record in records))
    for name, unit in found.units.items():
        table.add_row(name, unit, *("undefined" if record[name] is None else f"{record[name]:.4g}" for record in records))
    console.print(table)
    _say(console, f"The original vehicle {found.original.verdict}.")
    if found is not found.original and found.setting != found.original.setting:
        _say(console, f"The changed vehicle {found.verdict}: {_against(found)}.")


def _print_setting(console: Console, found: Simulation) -> None:
    table = WholeTable(title=plain(found.study.title))
    table.add_column("characteristic")
    table.add_column("unit")
    for head in ("original", "simulated"):
        table.add_column(head, justify="right")
    for member in CharacteristicSet.of(found.study.vehicle.characteristics):
        value = found.setting[member.name]
        changed = value != member.original
        note = f"{value:g}" + ("" if member.lower <= value <= member.upper else " (beyond)")
        table.add_row(plain(member.name), plain(member.unit), f"{member.original:g}", note, style="bold" if changed else None)
    console.print(table)


def _against(found: Simulation) -> str:
    here, there = found.metrics[SAFETY_DEGREE], found.original.metrics[SAFETY_DEGREE]
    if np.isnan(here) or np.isnan(there):
        return "nothing tells whether that is less safe"
    if here == there:
        return "as safe as the original"
    return f"{'less safe' if here < there else 'safer'} than the original, SD {here:.2f} against {there:.2f}"


def print_sweep(console: Console, study: Study, names: Sequence[str], original: Evaluations, found: Evaluations) -> None:
    """Many settings, a row each under the original vehicle's, by the values of the named characteristics."""
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    columns = [characteristics.names.index(name) for name in names]
    table = WholeTable(title=plain(study.title))
    for column in columns:
        unit = characteristics.members[column].unit
        table.add_column(plain(f"{names[columns.index(column)]}{'' if unit == '-' else f', {unit}'}"), justify="right")
    for head in ("outcome", *(METRICS[name].heading if name in METRICS else name for name in found.metrics)):
        table.add_column(head, justify="left" if head == "outcome" else "right")
    for which in (original, found):
        for row in range(len(which)):
            metrics = [which.metrics[name][row] for name in found.metrics]
            table.add_row(*(f"{which.settings[row, column]:g}" for column in columns), str(which.outcome[row]),
                          *("-" if np.isnan(value) else f"{value:.3f}" for value in metrics), end_section=which is original)
    console.print(table)
    _say(console, "First the original vehicle. SD: least distance in m, or minus the collision's speed in m/s.")


def print_names(console: Console, title: str, rows: Iterable[tuple[str, ...]], heads: tuple[str, ...]) -> None:
    """A plain table of what there is."""
    table = WholeTable(*heads, title=plain(title), title_justify="left")
    for row in rows:
        table.add_row(*(plain(cell) for cell in row))
    console.print(table)


def _say(console: Console, sentence: str) -> None:
    console.print(sentence, soft_wrap=True, markup=False, highlight=False)


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
