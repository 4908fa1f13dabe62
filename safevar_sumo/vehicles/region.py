"""The feasible region of a study: settings whose characteristics satisfy its constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, about, subject
from safevar_sumo.records import BoolArray, FloatArray, Quantity
from safevar_sumo.study import Constraint, Study, unit_text
from safevar_sumo.vehicles.characteristics import CharacteristicSet

BOUND_SLACK = 1e-9
"""Largest violation of bounds that counts as a rounding error, as a share of `_BoundedSum.width`
[-].
"""
N_REPAIR_SHARES = 64
"""Number of settings that a repair tries on the line from an infeasible setting to the original."""
REJECTIONS = 1000
"""Largest number of draws for each feasible setting that is wanted."""
LARGEST_DRAW = 10_000
"""Largest number of settings that are drawn at once, unless more are missing."""
N_PROBES = 10_000
"""Number of random settings that show whether random settings can be drawn."""
LEAST_FEASIBLE_SHARE = 0.002
"""Share of these settings that has to be feasible."""


class _BoundedSum(NamedTuple):
    """A weighted sum of characteristics with bounds, ready to compute: a constraint of a study.

    `width` is the range of the sum over the domains. `condition` states the bounds in words,
    `suffix` the unit.
    """

    constraint: Constraint
    width: float
    condition: str
    suffix: str

    @classmethod
    def of(
        cls, constraint: Constraint, study: Study, characteristics: CharacteristicSet
    ) -> _BoundedSum:
        """The computation of a study's constraint."""
        domains = study.domains
        widths = characteristics.named(characteristics.upper - characteristics.lower)
        width = sum(
            abs(weight) * widths[name] for name, weight in constraint.sum.items()
        )
        return cls(
            constraint,
            width,
            constraint.bounds_in_words(domains),
            unit_text(constraint.unit_of(domains)),
        )

    def excess(self, values: Mapping[str, Quantity]) -> Quantity:
        """The violation of the bounds by values of characteristics, numbers or arrays of shape
        (N,), as a share of `width`; 0 within the bounds.
        """
        total = self.constraint.total(values)
        low, high = self.constraint.ends
        return np.maximum(np.maximum(low - total, total - high), 0.0) / self.width

    def __str__(self) -> str:
        return f"{self.constraint.quantity} {self.condition}"


@dataclass(frozen=True)
class FeasibleRegion:
    """Settings that satisfy all constraints of a study; without constraints, all settings."""

    characteristics: CharacteristicSet
    bounds: tuple[_BoundedSum, ...]

    def __bool__(self) -> bool:
        return bool(self.bounds)

    def __str__(self) -> str:
        return "; ".join(str(bound) for bound in self.bounds)

    def violation(self, settings: FloatArray) -> FloatArray:
        """The sum of a setting's violations of all constraints, shape (N,); 0 if it is feasible. A
        violation is a share of the range of the constraint's sum over the domains.
        """
        columns = self.characteristics.columns(settings)
        excess = np.zeros(len(settings))
        for bound in self.bounds:
            excess = excess + bound.excess(columns)
        return np.where(excess <= BOUND_SLACK, 0.0, excess)

    def feasible(self, settings: FloatArray) -> BoolArray:
        """Whether each setting satisfies all constraints, shape (N,)."""
        return np.asarray(self.violation(settings) == 0)

    def check(self, settings: FloatArray, *, otherwise: str = "") -> None:
        """Refuse settings, shape (N, n), that are not feasible. `otherwise` is added to the bound
        that the error states as legal.

        Raises
        ------
        InputError
            The error names a constraint that the first infeasible setting violates, and the values
            of this setting.
        """
        infeasible = settings[~self.feasible(settings)]
        if not len(infeasible):
            return
        values = self.characteristics.named(infeasible[0])
        # The sum of all violations is above `BOUND_SLACK`, so that one is above this share.
        bound = next(
            bound
            for bound in self.bounds
            if bound.excess(values) > BOUND_SLACK / len(self.bounds)
        )
        texts = [
            f"{member.name} = {values[member.name]:g}{member.suffix}"
            for member in self.characteristics
            if member.name in bound.constraint.sum
        ]
        total = f"{bound.constraint.total(values):g}{bound.suffix}"
        quantity = f"{bound.constraint.quantity} = {total}"
        raise InputError(
            "",
            f"violates a constraint: {quantity} ({', '.join(texts)})",
            bound.condition + otherwise,
        )

    def repaired(self, settings: FloatArray) -> FloatArray:
        """Settings, shape (N, n), moved towards the original setting until they are feasible after
        the filter. Settings that are feasible stay as they are.
        """
        repaired = settings.copy()
        original = self.characteristics.original
        infeasible = np.flatnonzero(~self._are_accepted(settings, filtered=True))
        for share in np.arange(N_REPAIR_SHARES - 1, -1, -1) / N_REPAIR_SHARES:
            if not len(infeasible):
                break
            repaired[infeasible] = original + share * (settings[infeasible] - original)
            infeasible = infeasible[
                ~self._are_accepted(repaired[infeasible], filtered=True)
            ]
        return repaired

    def draw_feasible(
        self, draw: Callable[[int], FloatArray], number: int, *, filtered: bool = False
    ) -> FloatArray:
        """The first `number` feasible settings that `draw` draws, shape (number, n); with
        `filtered`, settings that are feasible after the filter. There are fewer settings if
        `REJECTIONS` draws for each do not suffice. `draw(k)` draws k settings.
        """
        feasible_settings = np.zeros((0, len(self.characteristics)))
        draws = 0
        while len(feasible_settings) < number and draws < REJECTIONS * number:
            shortage = number - len(feasible_settings)
            # If few settings are feasible, each batch doubles the number of draws.
            settings = draw(max(shortage, min(draws, LARGEST_DRAW)))
            draws += len(settings)
            accepted = settings[self._are_accepted(settings, filtered)]
            feasible_settings = np.concatenate([feasible_settings, accepted[:shortage]])
        return feasible_settings

    def _are_accepted(self, settings: FloatArray, filtered: bool) -> BoolArray:
        if filtered:
            settings = self.characteristics.filter(settings)
        return self.feasible(settings)


def region_of(study: Study) -> FeasibleRegion:
    """The feasible region of a study.

    Raises
    ------
    InputError
        If the original vehicle is infeasible, or nearly every other setting is.
    """
    characteristics = CharacteristicSet.of(study)
    bounds = tuple(
        _BoundedSum.of(constraint, study, characteristics)
        for constraint in study.shared_constraints
    )
    region = FeasibleRegion(characteristics, bounds)
    if not bounds:
        return region

    with about(f"{subject()}: the original vehicle"):
        region.check(
            characteristics.original_settings,
            otherwise="; the original vehicle must satisfy every constraint",
        )

    # Searches filter random settings, and questions do not: enough of both must be feasible.
    probes = np.random.default_rng(0).uniform(
        characteristics.lower, characteristics.upper, (N_PROBES, len(characteristics))
    )
    share = np.mean(region.feasible(probes))
    share_after_filter = np.mean(region.feasible(characteristics.filter(probes)))
    if min(share, share_after_filter) < LEAST_FEASIBLE_SHARE:
        raise InputError(
            "",
            f"constraints: fewer than {LEAST_FEASIBLE_SHARE * 1000:g} in 1,000 random settings"
            f" satisfy them: {region}",
            "narrower domains or wider bounds, or one characteristic less, whose value your class"
            " computes from the others",
        )
    return region
