"""How the values of a calibrated study were found, in words for the head of its file."""

from __future__ import annotations

from collections.abc import Mapping

from safevar_sumo.reference.agreement import Agreement
from safevar_sumo.reference.calibration import Calibration
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import FreeParameter, Study

EDGE = 0.01
"""Nearer than this share of its width to an end, a value stands on its bound."""


def calibration_comment(found: Calibration, study: Study, references: Mapping[str, ReferenceData], *, from_scratch: bool) -> str:
    """Data with fingerprints, search, cost, agreement on both parts, and what stands on its bound."""
    fit = study.fit
    start = "random places alone" if from_scratch else f"its own values and {fit.starts} random places" if fit.starts else "its own values"
    parts = [
        f"  {name}: rho of the safety degree {_rho(found.used[name])} on the rows used, {_rho(found.held_back[name])} on those held back"
        for name in found.used]
    others = f" and to all but each {_ordinal(fit.hold_out)} row of" if references else "."
    return "\n".join([
        f"Study {study.name!r}, calibrated by CMA-ES ({fit.trials} trials, seed {fit.seed}, from {start})",
        f"to the original vehicle's published values{others}", *(_data_line(name, data) for name, data in references.items()),
        f"{cost_line(found)}.", *parts,
        *(f"{name} stands on its bound." for name in on_a_bound(found.values, study.calibration))])


def cost_line(found: Calibration) -> str:
    """The cost of what was found, and what each search came to if there was any."""
    reached = ", ".join(f"{cost:.4f}" for cost in found.reached)
    return f"Cost {found.cost:.4f}" + (f"; each search came to {reached}" if reached else "")


def on_a_bound(values: Mapping[str, float], free: Mapping[str, FreeParameter]) -> list[str]:
    """Names of the values that a search would have moved farther."""
    return [name for name, value in values.items()
            if min(value - free[name].lower, free[name].upper - value) <= EDGE * (free[name].upper - free[name].lower)]


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _data_line(name: str, data: ReferenceData) -> str:
    without = f", without {data.skipped} rows outside the domains" if data.skipped else ""
    return f"  {name}, SHA-256 {data.fingerprint}{without}"


def _rho(told: Agreement) -> str:
    rho = told.spearman["safety_degree"]
    return "undefined" if rho is None else f"{rho:.3f}"
