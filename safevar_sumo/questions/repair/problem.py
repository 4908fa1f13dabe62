"""The problem that a repair solves: which parameters of the ADS (the driving system) may change,
and which worn vehicles (the promise) must then be safe.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.ads import ADS
from safevar_sumo.ads.varied import CHANGEABLE
from safevar_sumo.campaign.evaluation import Selection
from safevar_sumo.errors import InputError, UserCodeError, about, unknown_name
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.cases import Space
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.preventability import approach_parameters
from safevar_sumo.questions.sampling import sobol_points
from safevar_sumo.questions.tolerance.oracle import CaseWorld, Oracle, product_of
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
from safevar_sumo.study.limits import check_limits
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import FeasibleRegion

DIGITS = 4
"""Significant digits of a parameter's changed value. A parameter whose range is small, compared
with its values, has more digits. Values are rounded before they are tried, so that the printed
value is the tried value.
"""
ARRAY_CHECKS = 8
"""Number of parameter sets with which a user's ADS is tried as one object that drives all vehicles.
"""
BRAKING_STAGE = "full braking"
ALL = "all"
"""The text of a promise that is the whole domain."""


class Parameter(NamedTuple):
    """A parameter of the ADS that may change. `range` has its bounds, `today` its present value."""

    name: str
    range: FreeParameter
    today: float

    def share(self, value: float) -> float:
        """The position of a value in the range: 0 at the lower bound, 1 at the upper bound. The
        position of a logarithmic parameter is that of the value's logarithm.
        """
        values = np.array([self.range.lower, self.range.upper, value])
        lower, upper, place = (np.log(values) if self.range.log else values).tolist()
        return float((place - lower) / (upper - lower))

    def values(self, shares: FloatArray) -> FloatArray:
        """The rounded values at M positions (`shares`) in the range, shape (M,)."""
        lower = self.range.lower
        upper = self.range.upper
        digits = DIGITS + max(
            0, int(np.log10(max(abs(lower), abs(upper)) / (upper - lower)))
        )
        exact = lower + shares * (upper - lower)
        if self.range.log:
            exact = lower * (upper / lower) ** shares
        distinct, row_of = np.unique(exact, return_inverse=True)
        return np.clip(
            [float(f"{value:.{digits}g}") for value in distinct.tolist()], lower, upper
        )[row_of]


@dataclass(frozen=True)
class Promise(Box):
    """The promised wear: a box of the worn vehicles that must be safe. Parameters of the scenario
    that the study varies take their whole domain.
    """

    @classmethod
    def of(cls, study: Study, region: FeasibleRegion, texts: Sequence[str]) -> Promise:
        """The promise that `texts` such as "treadDepth >= 2" state; without texts, the promise of
        the study.

        Raises
        ------
        InputError
            If a text cannot be read, its name is no characteristic, its value is outside of the
            domain, or no characteristic may wear.
        """
        domains = study.domains
        stated = study.repair.promise
        characteristics = region.characteristics
        if list(texts) == [ALL] or (not texts and stated == ALL):
            return cls(region, characteristics.lower, characteristics.upper)
        of_study = study.limits
        if stated and isinstance(stated, dict):
            of_study = stated
            with about(study.source):
                check_limits(domains, stated, "repair.promise.")
        with about("promise"):
            limits = limits_of(texts, domains, None if texts else of_study)
        if not limits:
            raise InputError(
                "promise",
                "nothing is promised",
                f'"NAME >= X" with one of {", ".join(domains)}; or {ALL}',
            )
        lower, upper = (
            np.where(characteristics.of_vehicle, characteristics.original, ends)
            for ends in (characteristics.lower, characteristics.upper)
        )
        for name, limit in limits.items():
            column = characteristics.names.index(name)
            lower[column], upper[column] = limit.interval(domains[name])
        if (lower == upper)[characteristics.of_vehicle].all():
            raise InputError(
                "promise",
                "promises a new vehicle only",
                "a limit short of the original's value",
            )
        return cls(region, lower, upper)

    def to_dict(self) -> dict[str, list[float]]:
        """The lower and upper end of every characteristic that may wear, and of every parameter of
        the scenario that varies, by name.
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
        """The promise in words: the limits of wear, such as `treadDepth >= 2 mm`, the values of all
        characteristics that must be as new, and the encounters.
        """
        ends = self.to_dict()
        limits = []
        as_new = []
        encounters = []
        is_whole = True
        for member in self.region.characteristics:
            low, high = ends.get(member.name, [member.original, member.original])
            if member.is_scenario:
                range_text = f"{low:.5g} to {high:.5g}{member.suffix}"
                encounters.append(f"{member.name} {range_text}")
                continue
            is_whole &= (low, high) == (member.lower, member.upper)
            if low == high:
                as_new.append(f"{member.name} {low:.5g}{member.suffix}")
                continue
            for sign, end in ((">=", low), ("<=", high)):
                if end != member.original:
                    limits.append(f"{member.name} {sign} {end:.5g}{member.suffix}")
        text = "the whole domain" if is_whole else ", ".join(limits)
        if as_new:
            text += f"; all others as in the original: {', '.join(as_new)}"
        if encounters:
            places = join_phrases(encounters)
            text += f", in the encounters with {places} that a new vehicle survives"
        return text


def parameters_of(study: Study, names: Sequence[str]) -> list[Parameter]:
    """The parameters of the ADS that may change: the table under [repair] of the study or, without
    a table, the parameters of a shipped ADS, whose ranges are widened to hold the present values.
    With `names`, only the parameters with these names.

    Raises
    ------
    InputError
        If no parameter may change, a name is unknown, or a parameter's present value is no number
        or outside of the bounds that the study states.
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
    for name, row in table.items():
        if name not in (names or table):
            continue
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
    """A study's ADS with P parameters that may change, and the cases of vehicles within a promise.

    A case is a vehicle in an encounter of a world: a row with the n values of the vehicle, the
    number of the world, and k places in the ranges of encounters (tolerance/oracle.py).

    A change is a set of P values of the parameters, as positions in their ranges: 0 is the lower
    bound, 1 the upper one. `shares` are M changes, shape (M, P).

    Attributes
    ----------
    oracle
        Simulates cases in its worlds: each test with each parameter set of the vehicle model.
    budget
        Number of cases that search for a counterexample to a change.
    drivers
        Evaluators with the driver that brakes fully at once, by the number of the world; None for a
        world without this driver. Filled when a world is needed.
    """

    oracle: Oracle
    promise: Promise
    parameters: list[Parameter]
    budget: int
    drivers: dict[int, Evaluator | None] = field(default_factory=dict)

    @property
    def evaluator(self) -> Evaluator:
        """The evaluator with the study's own parameter set."""
        return self.oracle.own.evaluator

    @property
    def unsafe(self) -> Unsafe:
        """The criterion of an unsafe vehicle with the study's own parameter set."""
        return self.oracle.own.unsafe

    @property
    def study(self) -> Study:
        """The study with its own parameter set."""
        return self.evaluator.study

    @property
    def size(self) -> int:
        """The number n of a vehicle's values."""
        return len(self.oracle.vehicle)

    @cached_property
    def today(self) -> FloatArray:
        """The present values of the parameters, as positions in their ranges, shape (P,)."""
        return np.array(
            [parameter.share(parameter.today) for parameter in self.parameters]
        )

    def values(self, shares: FloatArray) -> FloatArray:
        """The values of the parameters in their units, shape (M, P). A position that is today's
        becomes exactly today's value, without rounding.
        """
        columns = [
            np.where(column == today, parameter.today, parameter.values(column))
            for parameter, column, today in zip(
                self.parameters, shares.T, self.today, strict=True
            )
        ]
        return np.column_stack(columns)

    def changed_values(self, change: FloatArray) -> NamedValues:
        """The new values, by name, of the parameters that a change, shape (P,), changes."""
        (values,) = self.values(change[np.newaxis]).tolist()
        pairs = zip(self.parameters, values, strict=True)
        changed = compress(pairs, change != self.today)
        return {parameter.name: value for parameter, value in changed}

    @cached_property
    def drives_arrays(self) -> bool:
        """Whether one object of the ADS drives vehicles with different parameters, as arrays. A
        shipped ADS does, an FMU or a TraCI controller does not. A user's class does if a sample has
        the same results, to the bit, as with an object for each change.
        """
        if self.study.ads.kind:
            return False
        if self.study.ads.model in ADS:
            return True
        values = self.values(sobol_points(ARRAY_CHECKS, len(self.parameters), 0))
        points = sobol_points(ARRAY_CHECKS, len(self.promise.lower), 1)
        rows = np.hstack([self.promise.at(points), values])
        stage = "is it one driving system?"
        try:
            alone, together = (
                self.evaluator.evaluate_selection(rows, self._selection(arrays), stage)
                for arrays in (False, True)
            )
        except UserCodeError:
            return False
        return not any(differences(alone.results, together.results))

    def _selection(self, arrays: bool) -> Selection:
        """The selection for rows in which the parameters' values follow the setting."""
        names = tuple(parameter.name for parameter in self.parameters)
        return Selection(parameters=names, arrays=arrays)

    def evaluate(
        self, model: Model, shares: FloatArray, settings: FloatArray, stage: str
    ) -> Evaluations:
        """The M * L evaluations of M changes, each with the L settings of a model in order."""
        values = np.repeat(self.values(shares), len(settings), axis=0)
        rows = np.hstack([np.tile(settings, (len(shares), 1)), values])
        selection = self._selection(self.drives_arrays)
        return model.evaluator.evaluate_selection(rows, selection, stage)

    def outcome_today(self, case: FloatArray) -> Evaluations:
        """The evaluation of a case, shape (n + 1 + k,), with the present ADS."""
        model, setting = self.oracle.setting(case)
        stage = "the driving system of today"
        return self.evaluate(model, self.today[np.newaxis], setting[np.newaxis], stage)

    def cases_of(self, settings: FloatArray) -> FloatArray:
        """Settings of the study as cases with the study's own parameter set, in the first world and
        at phase 0.
        """
        n = self.size
        axes = self.promise.region.characteristics.scenario
        cases = np.zeros((len(settings), n + 1 + self.oracle.places))
        cases[:, :n] = settings[:, :n]
        places = (settings[:, n:] - axes.lower) / (axes.upper - axes.lower)
        cases[:, n + 2 : n + 2 + len(axes)] = places
        return cases

    @cached_property
    def new_vehicle_settings(self) -> FloatArray:
        """Settings of the new vehicle, shape (K, n): in the original encounter, and in the promised
        encounters among those in which the new vehicle is least safe.
        """
        original = self.promise.region.characteristics.original
        settings = self.evaluator.critical_encounters
        return np.vstack([original, settings[self.promise.holds(settings)]])

    def robustness_of_changes(
        self, shares: FloatArray, cases: FloatArray, stage: str
    ) -> FloatArray:
        """The robustness (distance to the limit of the criterion) of L cases with each of M
        changes, shape (M, L). Minus infinity marks a case without a valid simulation (see
        `Model.robustness_by`). Infinity marks a case that violates a constraint, or has no
        conflict.
        """
        robustness = np.zeros((len(shares), len(cases)))
        for number, rows, settings in self.oracle.in_worlds(cases):
            model = self.oracle.worlds[number].model
            evaluations = self.evaluate(model, shares, settings, stage)
            of_world = model.robustness_by(evaluations, failed=-np.inf)
            robustness[:, rows] = of_world.reshape(len(shares), -1)
        return robustness

    def robustness_of_change(
        self, change: FloatArray, cases: FloatArray, stage: str
    ) -> FloatArray:
        """The robustness of L cases with one change, shape (L,)."""
        return self.robustness_of_changes(change[np.newaxis], cases, stage).reshape(-1)

    def counted_robustness(
        self, change: FloatArray, cases: FloatArray, stage: str
    ) -> FloatArray:
        """The robustness of L cases with one change, shape (L,). An unsafe case does not count, and
        becomes infinity, in an encounter that is not promised, or if no driving system can keep the
        case safe.
        """
        robustness = self.robustness_of_change(change, cases, stage)

        # Whether a case counts takes further simulations: only the few unsafe cases are asked.
        unsafe = np.flatnonzero(robustness < 0)
        is_promised = self.is_promised(cases[unsafe])
        promised = unsafe[is_promised]
        is_repairable = self.repairable(cases[promised])
        robustness[unsafe[~is_promised]] = np.inf
        robustness[promised[~is_repairable]] = np.inf
        return robustness

    def is_promised(self, cases: FloatArray) -> BoolArray:
        """Which cases are in a promised encounter, shape (L,). A listed encounter is promised at
        any phase, any other encounter if the present ADS keeps a new vehicle safe in it.
        """
        # A world without a test holds listed encounters only, unless the encounters are ranges.
        is_promised = np.full(len(cases), not self.study.ranges)
        for number, rows, settings in self.oracle.in_worlds(cases):
            world = self.oracle.worlds[number]
            if world.test is not None:
                is_promised[rows] &= self._is_listed(world, settings)
        originals = cases[~is_promised]
        originals[:, : self.size] = self.oracle.vehicle.original
        robustness = self.robustness_of_change(self.today, originals, "new vehicles")
        is_promised[~is_promised] = robustness >= 0
        return is_promised

    def _is_listed(self, world: CaseWorld, settings: FloatArray) -> BoolArray:
        """Which settings, shape (L, n), are in a listed encounter of the world's test."""
        places = world.listed()
        original = self.oracle.vehicle.original
        listed = world.settings(np.tile(original, (len(places), 1)), places)

        # The phase, if the world has one, is the last value of a setting: it is not compared.
        axes = slice(self.size, self.size + world.places - 1)
        is_same = settings[:, np.newaxis, axes] == listed[:, axes]
        return np.asarray(is_same.all(axis=2).any(axis=1))

    @cached_property
    def encounters(self) -> FloatArray:
        """The E promised listed encounters, shape (E, 1 + k), as the last numbers of a case."""
        listed = np.unique(self.oracle.listed(), axis=0)
        originals = product_of(self.oracle.vehicle.original[np.newaxis], listed)
        return listed[self.is_promised(originals)]

    def space(self, fit: int) -> Space:
        """The space of the promised cases with the parameter set number `fit`."""
        n = self.size
        return self.oracle.space(fit, self.promise.lower[:n], self.promise.upper[:n])

    def with_sets(self, cases: FloatArray, fits: IntArray | int) -> FloatArray:
        """The same cases, but with the parameter sets number `fits`."""
        # The worlds of set 0 are first, then as many worlds of each further set, in equal order.
        number = self.oracle.fits.count(0)
        cases = cases.copy()
        cases[:, self.size] = cases[:, self.size] % number + number * fits
        return cases

    def best_driver(self, model: Model) -> Evaluator | None:
        """The evaluator with a driver that brakes fully at the first possible moment. The result is
        None if this driver cannot approach as the ADS does (`approach_parameters`), or if the
        criterion bounds a metric, because full braking need not be best for a metric.
        """
        if self.unsafe.bound:
            return None
        system = model.evaluator.system
        # The phase does not change the approach: the system without the phase has one encounter.
        if system.characteristics.scenario.names == (PHASE,):
            system = self.evaluator.system
        approach = approach_parameters(system)
        if approach is None:
            return None
        ads = ModelTable(model="full_braking", parameters=approach)
        study = replace_in(model.evaluator.study, ads=ads, spread={})
        return model.evaluator.for_study(study, verified=0)

    def repairable(self, cases: FloatArray) -> BoolArray:
        """Which cases a driving system can keep safe: a driver that brakes fully at the first
        possible moment, or the present ADS. In a world without this driver, all cases count.
        """
        is_safe = np.ones(len(cases), dtype=bool)
        for number, rows, settings in self.oracle.in_worlds(cases):
            model = self.oracle.worlds[number].model
            if number not in self.drivers:
                self.drivers[number] = self.best_driver(model)
            driver = self.drivers[number]
            if driver is not None:
                evaluations = driver.evaluate(settings, BRAKING_STAGE)
                is_kept_safe = model.unsafe.robustness(evaluations) >= 0
                is_safe[rows] = evaluations.valid & is_kept_safe

        # The present ADS may keep a case safe that full braking does not: braking later can be
        # better.
        robustness = self.robustness_of_change(
            self.today, cases[~is_safe], BRAKING_STAGE
        )
        is_safe[~is_safe] = robustness >= 0
        return is_safe
