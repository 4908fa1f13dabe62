"""What was found about limits, as it is told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.cases import Counterexamples
from safevar_sumo.questions.counterexamples import FURTHER_DIGITS, Failure, describe
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance.alone import Side
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.search import FoundLimits
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import Characteristic

DECIMALS = 3
"""Decimals of limits beyond those that are printed: further ones are rounding errors."""


class InRanges(NamedTuple):
    """The searches for counterexamples to limits in the ranges of a study, one in each parameter
    set.
    """

    asked: Asked
    unsafe: Unsafe
    attacks: Sequence[Counterexamples]


@dataclass(frozen=True)
class Told:
    """What was found, and how it is told.

    Attributes
    ----------
    columns
        The columns of the characteristics that vary.
    has_scan
        Whether enough values were simulated to state limits alone.
    up_to, tests_left_out
        Where the study was cut, and the names of the tests above.
    """

    asked: Asked
    limits: FoundLimits
    unsafe: Unsafe
    original: Evaluations
    columns: Sequence[int]
    is_rough: bool
    has_scan: bool
    at_tests: bool
    up_to: str | None
    tests_left_out: Sequence[str]

    @property
    def study(self) -> Study:
        """The study."""
        return self.own.evaluator.study

    @property
    def own(self) -> Model:
        """The first model with the study's own parameter set."""
        return self.asked.oracle.own

    @cached_property
    def scope(self) -> str:
        """What the limits cover."""
        return scope_of(self.study, between=not self.at_tests)

    @property
    def is_safe(self) -> bool:
        """Whether the original vehicle is safe."""
        return not self.unsafe.of(self.original)[0]

    @property
    def members(self) -> Sequence[Characteristic]:
        """The characteristics of the vehicle."""
        return self.asked.oracle.vehicle.members

    @cached_property
    def box(self) -> Box | None:
        """The joint limits; none of few simulations if they leave a characteristic no room."""
        sides = self.limits.sides
        is_of_use = sides is not None and (self.has_scan or not self.without_room)
        return self.box_of(sides) if sides is not None and is_of_use else None

    @property
    def without_room(self) -> list[str]:
        """The characteristics that could not change at all in the box that was found."""
        boxes, sides = self.limits.boxes, self.limits.sides
        if sides is None:
            return []
        is_closed = boxes.is_free.any(axis=0) & (sides.sum(axis=0) == 0)
        return [
            self.members[column].name for column in np.flatnonzero(is_closed).tolist()
        ]

    def box_of(self, sides: FloatArray) -> Box:
        """A box of vehicles as it is printed."""
        vehicle = self.asked.oracle.vehicle
        decimals = [item.digits + DECIMALS for item in vehicle]
        ends = np.array(
            [
                [
                    round(end, number)
                    for end, number in zip(of_side.tolist(), decimals, strict=True)
                ]
                for of_side in self.limits.boxes.ends(sides)
            ]
        )
        given = np.where(self.limits.boxes.is_free, np.nan, self.asked.given)
        ends = np.where(np.isnan(given), ends, given)
        lower, upper = np.clip(ends, vehicle.lower, vehicle.upper)
        return Box(self.own.evaluator.region, lower, upper)

    def failure(self, case: FloatArray, box: Box | None = None) -> Failure | None:
        """How a case fails, with the values that are printed; those within a box stay there."""
        if self.asked.oracle.available < len(FURTHER_DIGITS):
            return None
        model, setting = self.asked.oracle.setting(case)
        within = None if box is None else box.in_encounters_of(model.evaluator.region)
        return describe(model, {"": setting}, within).get("")

    @cached_property
    def failures(self) -> Mapping[int, Failure]:
        """How the vehicle fails just beyond a limit, by column: beyond the joint one, or alone."""
        beyond = self.limits.beyond
        if self.box is None:
            beyond = self.limits.alone.beyond
        failures = dict[int, Failure]()
        for (_, column), case in sorted(beyond.items(), key=self._change):
            failure = None if column in failures else self.failure(case, self.box)
            if failure is not None:
                failures[column] = failure
        return failures

    def _change(self, beyond: tuple[Side, FloatArray]) -> float:
        """How far a case beyond a side is from the original."""
        (_, column), case = beyond
        return abs(float(case[column] - self.asked.original[column]))

    def alone(self, column: int) -> tuple[float, float] | tuple[None, None]:
        """What is safe alone, rounded inwards; nothing where it was not scanned."""
        if not (self.is_safe and self.has_scan):
            return None, None
        alone = self.limits.alone
        low, high = (
            self._feasible(column, ends[column]) for ends in (alone.lower, alone.upper)
        )
        return self.members[column].rounded_inwards((low, high))

    def _feasible(self, column: int, end: float) -> float:
        """The last value on the way to a limit alone that satisfies the study's constraints."""
        region = self.own.evaluator.region
        start = region.characteristics.original_settings
        setting = start.copy()
        setting[0, column] = end
        if region.feasible(setting)[0]:
            return float(end)
        line = find_boundaries(start, setting, lambda rows: ~region.feasible(rows))
        return float(line.safe[0, column])

    def given(self, column: int) -> tuple[float | None, float | None]:
        """The specified limit."""
        low, high = self.asked.given[:, column].tolist()
        return (None if np.isnan(low) else low), (None if np.isnan(high) else high)

    def outside(self, column: int) -> float:
        """How far a specified limit is beyond what is safe alone; 0 if it is not."""
        low, high = self.members[column].rounded_inwards(
            (
                float(self.limits.alone.lower[column]),
                float(self.limits.alone.upper[column]),
            )
        )
        given = self.asked.given[:, column]
        return float(np.nanmax([low - given[0], given[1] - high, 0.0]))

    @cached_property
    def broken(self) -> list[int]:
        """The columns of the specified limits that are not kept."""
        stated = np.flatnonzero(~np.isnan(self.asked.given).all(axis=0)).tolist()
        if self.limits.broken or not self.is_safe:
            return stated
        return [column for column in stated if self._is_broken(column)]

    def _is_broken(self, column: int) -> bool:
        """Whether a specified limit is beyond what is safe alone. A rough search has wide gaps
        between what is safe and what is not: there an unsafe vehicle must be within the limit.
        """
        if not self.is_rough:
            return self.outside(column) > 0
        lengths = np.abs(self.asked.given[:, column] - self.asked.original[column])
        return any(
            beyond[0][1] == column and self._change(beyond) <= lengths[beyond[0][0]]
            for beyond in self.limits.alone.beyond.items()
        )

    def value_in(self, fit: int) -> float:
        """The worst that the search found in a parameter set: a clearance [m], or a metric."""
        unsafe = self.unsafe if fit == 0 else replace(self.unsafe, keep=0.0)
        return unsafe.value(self.limits.attacks[fit].least)

    @property
    def least(self) -> float | None:
        """The worst that the search found in any parameter set; None without an encounter."""
        values = map(self.value_in, self.limits.attacks)
        finite = [value for value in values if np.isfinite(value)]
        return float(self.unsafe.worst(finite)) if finite else None

    @property
    def kept(self) -> bool | None:
        """Whether the specified limits hold, and the original is safe; None if it is not known."""
        if self.broken or not self.is_safe:
            return False
        return None if self.is_rough else True
