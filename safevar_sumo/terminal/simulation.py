"""One simulation or a sweep of them, and lists of what there is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from rich.console import Console

from safevar_sumo.api import Simulation
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.study import Study
from safevar_sumo.terminal.plain import WholeTable, plain, print_meanings
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
    here, there = found.metrics["safety_degree"], found.original.metrics["safety_degree"]
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
