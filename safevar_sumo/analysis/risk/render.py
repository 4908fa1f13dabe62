"""How likely an unsafe outcome is, for a reader."""

from __future__ import annotations

import math

from rich.console import Console
from rich.markup import escape

from safevar_sumo.analysis.risk.compute import Risk
from safevar_sumo.study import Study
from safevar_sumo.study.variation import Uniform
from safevar_sumo.terminal import WholeTable, print_meanings
from safevar_sumo.vehicles import CharacteristicSet


def print_risk(console: Console, told: Risk) -> None:
    """The probability with its interval, how vehicles vary, and what decides."""
    low, high = told.interval
    _say(console, told.study.title)
    _say(console, f"Unsafe: {told.unsafe}. {told.failures} of {told.samples} vehicles.")
    name = "Share of the domain that is unsafe:" if told.of_domain else "Probability"
    _say(console, f"{name} {told.probability:.4g}, with {told.confidence:.0%} confidence from {low:.4g} to {high:.4g}.")
    if told.of_domain:
        _say(console, "warning: this is no probability in the field: the study has no [variation] table that says how real vehicles vary.")
    _say(console, _variation(told.study))
    if told.sensitivity is None or told.sensitivity_of_unsafe is None:
        return
    table = WholeTable("characteristic", title="What decides: share of the variance", title_justify="left")
    for what in ("SD", "unsafe"):
        table.add_column(f"{what}: alone", justify="right")
        table.add_column("in all", justify="right")
    second = told.sensitivity_of_unsafe.set_index("characteristic")
    for row in told.sensitivity.sort_values("total", ascending=False, kind="stable").to_dict("records"):
        other = second.loc[row["characteristic"]]
        table.add_row(escape(row["characteristic"]), *(_index(one, name) for one in (row, other) for name in ("first_order", "total")))
    console.print(table)
    if told.sensitivity_of_unsafe["total"].isna().all():
        _say(console, "Too few settings are unsafe, or safe, to tell what decides that; the safety degree tells more.")
    print_meanings(console, CharacteristicSet.of(told.study.vehicle.characteristics))
    console.print(f"Sobol indices, first order and total, with half of their {told.confidence:.0%} intervals.", highlight=False)


def _variation(study: Study) -> str:
    """How vehicles vary, in a sentence."""
    laws = [f"{name} {law.__struct_config__.tag}" for name, law in study.variation.items() if law != Uniform()]
    correlated = ", ".join(f"{' with '.join(one.between)} {one.value:g}" for one in study.correlations)
    varied = f"as the study says: {'; '.join(laws)}; the others uniformly" if laws else "uniformly over the whole domain"
    return f"They vary {varied}{f', correlated: {correlated}' if correlated else ''}."


def _index(row: object, name: str) -> str:
    value, low, high = (float(row[f"{name}{end}"]) for end in ("", "_lower", "_upper"))  # type: ignore[index]
    return "-" if math.isnan(value) else f"{value:.2f} ±{(high - low) / 2:.2f}"


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)
