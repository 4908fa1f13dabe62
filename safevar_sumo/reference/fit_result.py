"""The result of a fit, and its description for people and for the head of a study file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.validation import Agreement
from safevar_sumo.study import SAFETY_DEGREE, FitTable, FreeParameter, Study

EDGE = 0.01
"""A value nearer to a bound than this share of the bounds' width lies on its bound."""


class Calibration(NamedTuple):
    """Fitted values and bounds by parameter, the study with these values, their loss, and agreement with both parts of each reference.

    `reached` is the lowest loss of each search; the last search starts at the studies' own values, except in a fit from scratch.
    `together` names the studies that were fitted with this one, `shared` the parameters that it shares with one of them,
    `search` is the table [fit] that set trials, seed and starts, `intervals` are the least and the greatest value of each
    parameter that fit as well, `profiles` are the losses of the trials.
    """

    values: dict[str, float]
    study: Study
    loss: float
    reached: list[float]
    used: dict[str, Agreement]
    held_back: dict[str, Agreement]
    bounds: dict[str, FreeParameter]
    search: FitTable
    together: tuple[str, ...] = ()
    shared: frozenset[str] = frozenset()
    intervals: Mapping[str, tuple[float, float]] = MappingProxyType({})
    profiles: Profiles | None = None

    @property
    def on_a_bound(self) -> list[str]:
        """Names of the parameters whose values lie on a bound."""
        return [name for name, value in self.values.items()
                if min(value - (bounds := self.bounds[name]).lower, bounds.upper - value) <= EDGE * (bounds.upper - bounds.lower)]

    @property
    def loss_line(self) -> str:
        """The lowest loss, and the lowest loss of each search, if any."""
        reached = ", ".join(f"{loss:.4f}" for loss in self.reached)
        return f"Loss {self.loss:.4f}" + (f"; lowest loss of each search: {reached}" if reached else "")

    def comment(self, study: Study, references: Mapping[str, ReferenceData], *, from_scratch: bool) -> str:
        """The fit in words: data with fingerprints, search, loss, agreement on both parts, shared parameters, values on a bound."""
        fit = self.search
        start = "its own values" + (f" and {fit.starts} random places" if fit.starts else "")
        start = "random places only" if from_scratch else start
        parts = [
            f"  {name}: rho of the safety degree {_rho(self.used[name])} on the rows used, {_rho(self.held_back[name])} on those held back"
            for name in self.used]
        rows = f" and to all but every {_ordinal(study.fit.hold_out)} row of" if references else "."
        together = f" together with {' and '.join(map(repr, self.together))}" if self.together else ""
        own = [name for name in self.values if name not in self.shared]
        return "\n".join([
            f"Study {study.name!r}, calibrated{together} by CMA-ES ({fit.trials} trials, seed {fit.seed}, from {start})",
            f"to the original vehicle's published values{rows}", *(_data_line(name, data) for name, data in references.items()),
            *([f"Parameters of its own: {', '.join(own) or 'none'}; it shares the others."] if self.together else []),
            f"{self.loss_line}.", *parts,
            *(f"{name} lies on its bound." for name in self.on_a_bound)])


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _data_line(name: str, data: ReferenceData) -> str:
    without = f", without {data.skipped} rows outside the domains" if data.skipped else ""
    return f"  {name}, SHA-256 {data.fingerprint}{without}"


def _rho(result: Agreement) -> str:
    rho = result.spearman[SAFETY_DEGREE]
    return "undefined" if rho is None else f"{rho:.3f}"


def fitted_as(study: Study, fitted: Study) -> Study:
    """The fitted study under a name of its own, so that nobody takes it for the study that it was fitted from."""
    return msgspec.structs.replace(fitted, name=f"{study.name}-calibrated")
