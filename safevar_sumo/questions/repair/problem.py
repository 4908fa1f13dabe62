"""What a repair is asked: the promised wear, and the parameters of the ADS that may change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.ads import ADS
from safevar_sumo.ads.varied import CHANGEABLE
from safevar_sumo.campaign.evaluation import Selection
from safevar_sumo.errors import InputError, UserCodeError, about, unknown_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.between import moving_tests
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.cases import USUAL_BUDGET
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.preventability import approach_parameters
from safevar_sumo.questions.repair.full_braking import FullBraking, robustness_of
from safevar_sumo.questions.sampling import sobol_points
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import (
    BoolArray,
    Evaluations,
    FloatArray,
    IntArray,
    NamedValues,
    differences,
)
from safevar_sumo.study import PHASE, FreeParameter, ModelTable, Study, limits_of
from safevar_sumo.study.characteristics import check_limits
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import FeasibleRegion

DIGITS = 4
"""Significant digits of a parameter's changed value, more where its range is small beside it: the
value that is printed is the one that has been tried.
"""
ARRAY_CHECKS = 8
"""Sets of parameters with which a user's ADS is tried as one for all vehicles."""
DRAWS = 20
"""Largest number of draws for each one in an encounter in which a new vehicle is safe."""
ALL = "all"
"""The promise of the whole domain."""


class Parameter(NamedTuple):
    """A parameter of the ADS that may change, with its `range` and the value of `today`."""

    name: str
    range: FreeParameter
    today: float

    def share(self, value: float) -> float:
        """Where a value lies in the range, in [0, 1]; of the logarithm if the parameter is
        logarithmic.
        """
        ends = np.array([self.range.lower, self.range.upper, value])
        lower, upper, place = (np.log(ends) if self.range.log else ends).tolist()
        return float((place - lower) / (upper - lower))

    def values(self, shares: FloatArray) -> FloatArray:
        """The rounded values at shares of the range, shape (M,)."""
        lower = self.range.lower
        upper = self.range.upper
        digits = DIGITS + max(
            0, int(np.log10(max(abs(lower), abs(upper)) / (upper - lower)))
        )
        exact = (
            lower * (upper / lower) ** shares
            if self.range.log
            else lower + shares * (upper - lower)
        )
        distinct, row_of = np.unique(exact, return_inverse=True)
        return np.clip(
            [float(f"{value:.{digits}g}") for value in distinct.tolist()], lower, upper
        )[row_of]


@dataclass(frozen=True)
class Promise(Box):
    """The promised wear: a box in which parameters of the scenario that the study searches take
    their whole domain.
    """

    @classmethod
    def of(cls, study: Study, region: FeasibleRegion, texts: Sequence[str]) -> Promise:
        """The promise that texts such as "treadDepth >= 2" state, or the study's own without any.

        Raises
        ------
        InputError
            If a promise cannot be read, names no characteristic, lies outside its domain, or lets
            nothing wear.
        """
        rows = study.domains
        stated = study.repair.promise
        everything = region.characteristics
        if list(texts) == [ALL] or (not texts and stated == ALL):
            return cls(region, everything.lower, everything.upper)
        of_study = stated if stated and isinstance(stated, dict) else study.limits
        with about(study.source):
            check_limits(rows, of_study, "repair.promise.")
        with about("promise"):
            limits = limits_of(texts, rows, None if texts else of_study)
        if not limits:
            raise InputError(
                "promise",
                "nothing is promised",
                f'"NAME >= X" with one of {", ".join(rows)}; or {ALL}',
            )
        lower, upper = (
            np.where(everything.of_vehicle, everything.original, ends)
            for ends in (everything.lower, everything.upper)
        )
        for name, limit in limits.items():
            column = everything.names.index(name)
            lower[column], upper[column] = limit.interval(rows[name])
        if (lower == upper)[everything.of_vehicle].all():
            raise InputError(
                "promise",
                "promises a new vehicle only",
                "a limit short of the original's value",
            )
        return cls(region, lower, upper)

    def to_dict(self) -> dict[str, list[float]]:
        """The ends of every characteristic that may wear, and of every parameter of the scenario
        that varies.
        """
        names = self.region.characteristics.names
        ends = np.transpose([self.lower, self.upper]).tolist()
        return {
            name: pair
            for name, pair in zip(names, ends, strict=True)
            if pair[0] < pair[1]
        }

    @property
    def in_words(self) -> str:
        """The worn ends, such as `treadDepth >= 2 mm, brakeTorque >= 0.8`, what is as new, and the
        encounters.
        """
        ends = self.to_dict()
        characteristics = self.region.characteristics
        whole_domain = all(
            ends.get(member.name) == [member.lower, member.upper]
            for member in characteristics.vehicle
        )
        worn = ", ".join(
            f"{member.name} {sign} {end:.5g}{member.suffix}"
            for member in characteristics.vehicle
            if member.name in ends
            for sign, end in zip((">=", "<="), ends[member.name], strict=True)
            if end != member.original
        )
        worn = "the whole domain" if whole_domain else worn
        as_new = [
            f"{member.name} {member.original:.5g}{member.suffix}"
            for member in characteristics.vehicle
            if member.name not in ends
        ]
        if as_new:
            worn += f"; all others as in the original: {', '.join(as_new)}"
        encounters = [
            f"{member.name} {ends[member.name][0]:.5g} to {ends[member.name][1]:.5g}{member.suffix}"
            for member in characteristics.scenario
            if member.name in ends
        ]
        where = (
            f", in the encounters with {join_phrases(encounters)} that a new vehicle survives"
            if encounters
            else ""
        )
        return worn + where


def parameters_of(study: Study, names: Sequence[str]) -> list[Parameter]:
    """The parameters that may change: those called `names`, or all under [repair], or those of a
    shipped ADS.

    Raises
    ------
    InputError
        If there is none, one is unknown, or its bounds exclude the value of today.
    """
    source = study.source
    shipped = CHANGEABLE.get(study.ads.model, {})
    table = study.repair.parameters or shipped
    if not table:
        raise InputError(
            source,
            f"ads.model = {study.ads.model!r}: no parameter may change",
            "parameters under [repair], such as gain = { lower, upper, unit, meaning }",
        )
    for name in names:
        if name not in table:
            raise unknown_name(
                "change",
                f"{study.ads.model} has no parameter {name!r} that may change",
                name,
                table,
            )
    ads = assemble(study).ads
    parameters = []
    for name in (name for name in table if name in (names or table)):
        row = table[name]
        today = study.ads.parameters.get(name, getattr(ads, name, None))
        number = float(today) if isinstance(today, int | float) else math.nan
        if table is shipped:
            row = replace_in(
                row, lower=min(row.lower, number), upper=max(row.upper, number)
            )
        if (
            not row.lower <= number <= row.upper
            or row.lower == row.upper
            or (row.log and row.lower <= 0)
        ):
            raise InputError(
                source,
                f"repair.{name}: lower = {row.lower:g}, upper = {row.upper:g},"
                f" ads.parameters.{name} = {today!r}",
                f"{'0 < ' if row.log else ''}lower < upper, and bounds that hold the"
                " value of today",
            )
        parameters.append(Parameter(name, row, number))
    return parameters


@dataclass(frozen=True, kw_only=True)
class RepairProblem:
    """A study's ADS with P parameters that may change, and what is `unsafe` within a promise, with
    one parameter set of the vehicle model, number `fit`. `budget` is the number of simulations of
    a falsification over all parameter sets.

    Sets of parameters, shape (M, P), are shares of the range from lower to upper bound in [0, 1].
    """

    evaluator: Evaluator
    promise: Promise
    parameters: list[Parameter]
    unsafe: Unsafe
    fit: int = 0
    budget: int = USUAL_BUDGET

    @property
    def study(self) -> Study:
        return self.evaluator.study

    def between(self, new_car: Unsafe) -> list[RepairProblem]:
        """The same problem in each test of its matrix that moves, with its axes as ranges."""
        tests = moving_tests(Model(self.fit, self.evaluator, self.unsafe), new_car)
        return [
            replace(
                self,
                evaluator=test.model.evaluator,
                promise=Promise(**vars(test.box(self.promise))),
            )
            for test in tests
        ]

    def in_phases(self) -> list[RepairProblem]:
        """The same problem with settings that end with the phase of their encounter, if it has
        phases.
        """
        model = Model(self.fit, self.evaluator, self.unsafe).in_phases
        if model is None:
            return []
        lower, upper = (
            np.append(self.promise.lower, 0.0),
            np.append(self.promise.upper, 1.0),
        )
        promise = Promise(model.evaluator.region, lower, upper)
        return [replace(self, evaluator=model.evaluator, promise=promise)]

    @property
    def has_phases(self) -> bool:
        """Whether settings end with the phase of their encounter."""
        return self.evaluator.characteristics.names[-1] == PHASE

    @cached_property
    def today(self) -> FloatArray:
        """The parameters of today, shape (P,)."""
        return np.array(
            [parameter.share(parameter.today) for parameter in self.parameters]
        )

    def values(self, shares: FloatArray) -> FloatArray:
        """The parameters' values in their units, shape (M, P): today's value where a share is
        today's.
        """
        columns = [
            np.where(column == today, parameter.today, parameter.values(column))
            for parameter, column, today in zip(
                self.parameters, shares.T, self.today, strict=True
            )
        ]
        return np.stack(columns, axis=1)

    def changed_values(self, change: FloatArray) -> NamedValues:
        """The values of the parameters that a change, one set of shape (P,), changes, by name."""
        (values,) = self.values(change[np.newaxis]).tolist()
        names = [parameter.name for parameter in self.parameters]
        return {
            names[column]: values[column]
            for column in np.flatnonzero(change != self.today)
        }

    @cached_property
    def arrays(self) -> bool:
        """Whether one ADS drives vehicles with different parameters: a shipped one, or the user's
        class if a sample has the same results to the bit; otherwise there is an instance for each
        set.
        """
        if self.study.ads.kind or self.study.ads.model in ADS:
            return not self.study.ads.kind
        values = self.values(sobol_points(ARRAY_CHECKS, len(self.parameters), 0))
        settings = self.promise.at(
            sobol_points(ARRAY_CHECKS, len(self.promise.lower), 1)
        )
        try:
            alone, together = (
                self._evaluate(
                    values, settings, "is it one driving system?", arrays=arrays
                )
                for arrays in (False, True)
            )
        except UserCodeError:
            return False
        return not any(differences(alone.results, together.results))

    def _evaluate(
        self,
        values: FloatArray,
        settings: FloatArray,
        stage: str,
        points: Sequence[int] = (),
        *,
        arrays: bool,
    ) -> Evaluations:
        """Evaluate each set of values with the setting of its row, at the worst of `points`, or of
        all without any.
        """
        selection = Selection(
            tuple(parameter.name for parameter in self.parameters),
            tuple(points) or None,
            arrays,
        )
        return self.evaluator.evaluate_selection(
            np.hstack([settings, values]), selection, stage
        )

    def robustness_of_each(
        self,
        shares: FloatArray,
        settings: FloatArray,
        stage: str,
        points: Sequence[int] = (),
    ) -> tuple[FloatArray, IntArray | None]:
        """What each of M sets of parameters leaves to the limit with each of L settings, shape (M,
        L), and the worst points of these M L rows; None without a matrix.
        """
        values = self.values(np.repeat(shares, len(settings), axis=0))
        evaluations = self._evaluate(
            values,
            np.tile(settings, (len(shares), 1)),
            stage,
            points,
            arrays=self.arrays,
        )
        return (
            robustness_of(evaluations, self.unsafe).reshape(len(shares), len(settings)),
            evaluations.worst_points,
        )

    def robustness_with(
        self, change: FloatArray, settings: FloatArray, stage: str
    ) -> FloatArray:
        """What one set of parameters leaves to the limit with each of L settings, shape (L,)."""
        return self.robustness_of_each(change[np.newaxis], settings, stage)[0].reshape(
            -1
        )

    def worst_today(self, setting: FloatArray) -> Evaluations:
        """How the ADS of today ends with one setting, shape (n,)."""
        return self._evaluate(
            self.values(self.today[np.newaxis]),
            setting[np.newaxis],
            "the driving system of today",
            arrays=self.arrays,
        )

    def robustness(
        self, change: FloatArray, settings: FloatArray, stage: str
    ) -> FloatArray:
        """What settings leave to the margin with one set of parameters, shape (L,); infinite where
        they do not hold, or no driving system keeps them safe.
        """
        robustness = np.full(len(settings), np.inf)
        rows = np.flatnonzero(self.holds(settings))
        robustness[rows] = self.robustness_with(change, settings[rows], stage)
        unsafe = np.flatnonzero(robustness < 0)
        robustness[unsafe[~self.repairable(settings[unsafe])]] = np.inf
        return robustness

    def holds(self, settings: FloatArray) -> BoolArray:
        """Which settings are promised, shape (M,), in an encounter in which the ADS of today keeps
        a new vehicle safe; without a search of the scenario, all promised ones count.
        """
        is_promised = self.promise.holds(settings)
        characteristics = self.promise.region.characteristics
        if len(characteristics.scenario) and is_promised.any():
            originals = characteristics.with_original_vehicle(settings[is_promised])
            is_promised[is_promised] = (
                self.robustness_with(self.today, originals, "new vehicles") >= 0
            )
        return is_promised

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Settings that hold, drawn uniformly, shape (number, n); fewer if `DRAWS` times as many do
        not suffice.
        """
        settings = np.zeros((0, len(self.promise.lower)))
        for _ in range(DRAWS):
            drawn = self.promise.draw(number, rng)
            settings = np.concatenate([settings, drawn[self.holds(drawn)]])[:number]
            if len(settings) == number:
                break
        return settings

    @cached_property
    def encounters(self) -> FloatArray:
        """The new vehicle in the original encounter, and in those promised ones in which it is
        least safe of many drawn ones, shape (K, n).
        """
        original = self.promise.region.characteristics.original
        settings = self.evaluator.critical_encounters
        return np.concatenate(
            [original[np.newaxis], settings[self.promise.holds(settings)]]
        )

    @cached_property
    def best_driver(self) -> FullBraking | None:
        """Full braking at the first possible moment; None where it has no approach
        (`approach_parameters`), and by a bound of a measure, of which it need not be the best.
        """
        approach = (
            None if self.unsafe.bound else approach_parameters(self.evaluator.system)
        )
        if approach is None:
            return None
        ads = ModelTable(model="full_braking", parameters=approach)
        study = replace_in(self.study, ads=ads, spread={})
        return FullBraking(self.evaluator.for_study(study, verified=0), self.unsafe)

    def repairable(self, settings: FloatArray) -> BoolArray:
        """Which settings full braking at the first possible moment, or else the ADS of today, keeps
        safe; all without that driver.
        """
        if self.best_driver is None:
            return np.ones(len(settings), dtype=bool)
        is_safe = self.best_driver.saves(settings)
        unsafe = np.flatnonzero(~is_safe)
        is_safe[unsafe] = (
            self.robustness_with(self.today, settings[unsafe], "full braking") >= 0
        )
        return is_safe
