"""The result of a fit, and its description, which becomes the comment at the head of a study file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from safevar_sumo.reference.agreement import Agreement
from safevar_sumo.reference.profiles import Profiles
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE, FitTable, FreeParameter, Study

BOUND_MARGIN = 0.01
"""A value lies on a bound if its distance from the bound is at most this share of the bounds' width."""


class Calibration(NamedTuple):
    """The result of a fit: values and bounds by parameter; the study with these values, its loss, and its agreement with each reference.

    `used` is the agreement with the rows that the fit used, `held_back` with the other rows. `reached` holds the lowest loss of each
    search; the last search starts at the values in the study files, except in a fit from scratch. `search` is the table [fit] that set
    trials, seed and starts. `together` names the other studies of the fit, `shared` the parameters that this study shares with them.
    `intervals` hold the least and greatest value of each parameter that fit as well as the best.
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
                if min(value - (bounds := self.bounds[name]).lower, bounds.upper - value) <= BOUND_MARGIN * (bounds.upper - bounds.lower)]

    @property
    def loss_line(self) -> str:
        """A sentence with the lowest loss of all searches, and of each search."""
        losses = ", ".join(f"{loss:.4f}" for loss in self.reached)
        return f"Loss {self.loss:.4f}" + (f"; lowest loss of each search: {losses}" if losses else "")

    def comment(self, study: Study, references: Mapping[str, ReferenceData], *, from_scratch: bool) -> str:
        """The fit in words: search, data with fingerprints, shared parameters, loss, agreement, and values on a bound."""
        fit = self.search
        random_starts = f" and {fit.starts} random places" if fit.starts else ""
        start = "random places only" if from_scratch else f"its own values{random_starts}"
        agreement_lines = [
            f"  {name}: rho of the safety degree {_rho_text(used)} on the rows used, {_rho_text(self.held_back[name])} on those held back"
            for name, used in self.used.items()]
        rows = f" and to all but every {_format_ordinal(study.fit.hold_out)} row of" if references else "."
        together = f" together with {' and '.join(map(repr, self.together))}" if self.together else ""
        own_names = [name for name in self.values if name not in self.shared]
        return "\n".join([
            f"Study {study.name!r}, calibrated{together} by CMA-ES ({fit.trials} trials, seed {fit.seed}, from {start})",
            f"to the original vehicle's published values{rows}", *(_describe_data(name, data) for name, data in references.items()),
            *([f"Parameters of its own: {', '.join(own_names) or 'none'}; it shares the others."] if self.together else []),
            f"{self.loss_line}.", *agreement_lines,
            *(f"{name} lies on its bound." for name in self.on_a_bound)])


def _format_ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _describe_data(name: str, data: ReferenceData) -> str:
    skipped_rows = f", without {data.skipped} rows outside the domains" if data.skipped else ""
    return f"  {name}, SHA-256 {data.fingerprint}{skipped_rows}"


def _rho_text(result: Agreement) -> str:
    rho = result.spearman[SAFETY_DEGREE]
    return "undefined" if rho is None else f"{rho:.3f}"


def rename_fitted(study: Study, fitted: Study) -> Study:
    """The fitted study under the name `STUDY-calibrated`, so that it cannot be mistaken for the study before the fit."""
    return msgspec.structs.replace(fitted, name=f"{study.name}-calibrated")
