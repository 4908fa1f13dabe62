"""At which points of a matrix a setting fails, as a table: tests and weathers down, speeds across, impact locations in the cells."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from safevar_sumo.scenarios import Point

SPEED, LOCATION = "speed", "impact_location"
AVOIDED, FAILS = "–", "fails"  # noqa: RUF001


def failing_places(matrix: Sequence[Point], failing: Collection[str]) -> dict[str, Any]:
    """The table of the tests that fail somewhere.

    Parameters
    ----------
    matrix
        All points.
    failing
        Names of those that fail.

    Returns
    -------
    A sentence `told`, column `heads`, and `rows` of a name and a cell for each head; a cell is empty where nothing is tested.
    """
    places = [(point.name in failing, dict(point.place)) for point in matrix]
    speeds = sorted({place[SPEED] for _, place in places if SPEED in place})
    rows: dict[str, dict[Any, list[str]]] = {}
    for fails, place in places:
        speed, location = place.pop(SPEED, None), place.pop(LOCATION, None)
        name = ", ".join([str(place.pop("test", "")), str(place.pop("weather", "")), *(f"{key} {value}" for key, value in place.items())])
        cell = rows.setdefault(name, {}).setdefault(speed, [])
        if fails:
            cell.append(FAILS if location is None else f"{location:g} %")
    columns = [*speeds, *([None] if any(None in cells for cells in rows.values()) else [])]
    has_location = any(LOCATION in dict(point.place) for point in matrix if point.name in failing)
    return {
        "told": f"Fails at {len(failing)} of {len(matrix)} points.{' Percentages are impact locations.' if has_location else ''}",
        "heads": ["" if speed is None else f"{speed:g} km/h" for speed in columns],
        "rows": [(name, [", ".join(cells[speed]) or AVOIDED if speed in cells else "" for speed in columns])
                 for name, cells in rows.items() if any(cells.values())]}
