"""One simulation, and lists of what there is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet


def print_evaluation(console: Console, study: Study, record: Mapping[str, Any], characteristics: CharacteristicSet) -> None:
    """One simulation: the setting, how it ended, metrics and objectives."""
    table = Table("characteristic", "unit", title=escape(study.title))
    for head in ("original", "simulated"):
        table.add_column(head, justify="right")
    for member in characteristics:
        value = record["vcs"][member.name]
        table.add_row(member.name, member.unit, f"{member.original:g}", f"{value:g}", style="bold" if value != member.original else None)
    console.print(table)
    units = {"collision_speed": "m/s", "safety_degree": "m, or -m/s", "tet": "s", "tit": "s^2", "ave_dece": "m/s^2",
             "f_safe": "m, or -m/s", "f_diff": "fraction", "f_num_diff": "characteristics"}
    results = Table("result", "value", "unit")
    results.add_row("outcome", record["outcome"], "")
    for name, unit in units.items():
        value = record[name]
        results.add_row(name, "undefined" if value is None else f"{value:.4g}", unit)
    console.print(results)


def print_names(console: Console, title: str, rows: Iterable[tuple[str, ...]], heads: tuple[str, ...]) -> None:
    """A plain table of what there is."""
    table = Table(*heads, title=title, title_justify="left")
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    console.print(table)
