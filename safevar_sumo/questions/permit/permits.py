"""The greatest speed up to which each car is safe in all parameter sets of the vehicle model, and
the repair that raises this speed most.

"Speed" and "value" mean the parameter over which `permit` drives, which may be another quantity. A
car is measured: each measured value stands for all values between its errors of measurement.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import compress, product
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.models import Models
from safevar_sumo.questions.permit.encounters import Span, encounters_of
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.speed_search import (
    Cars,
    LimitingFailure,
    SpeedSearch,
)
from safevar_sumo.questions.words import EXACT
from safevar_sumo.records import BoolArray, FloatArray, NamedValues
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

REPAIR_STAGE = "cars with one part as new"
ENDS_STAGE = "cars with assumed values at ends of their domains"
USUAL_PLACES = 100
"""Usual number of encounters of a vehicle at one speed: all tests at all phases together."""
MOST_LIMITING = 3
"""Largest number of failures of a car that are simulated first with each of its repairs."""


class Reached(NamedTuple):
    """How far a car is safe in one parameter set.

    Attributes
    ----------
    fit
        The number of the parameter set.
    safe_value
        The greatest value up to which the car is safe; None if it fails already at the least value.
    failure
        The failure that limits the car; None if none was found.
    """

    fit: int
    safe_value: float | None
    failure: LimitingFailure | None

    @property
    def order(self) -> float:
        """`safe_value` as a number that can be compared: minus infinity stands for None."""
        return -np.inf if self.safe_value is None else self.safe_value


class Permit(NamedTuple):
    """How far a car is safe in each parameter set in which it was driven."""

    reached: list[Reached]

    @property
    def least(self) -> Reached:
        """The result with the parameter set that limits the car most."""
        return min(self.reached, key=lambda reached: reached.order)

    @property
    def safe_value(self) -> float | None:
        return self.least.safe_value

    @property
    def failures(self) -> list[LimitingFailure]:
        """The failures that limit the car, one for each parameter set in which one was found."""
        return [
            reached.failure for reached in self.reached if reached.failure is not None
        ]

    @property
    def limiting(self) -> list[LimitingFailure]:
        """The `MOST_LIMITING` failures at the least values, over all parameter sets."""
        ordered = sorted(self.failures, key=lambda failure: failure.value)
        return ordered[:MOST_LIMITING]

    @property
    def order(self) -> float:
        return self.least.order


Repaired = tuple[int, Permit] | None
"""The column of the characteristic whose repair raises a car's speed most, and how far the repaired
car is safe; None if no single repair raises the speed.
"""


class WorstEnd(NamedTuple):
    """The assumed (not measured) value of a car that lowers the car's speed most, if this value is
    at an end of its domain.

    Attributes
    ----------
    name
        The name of the characteristic.
    text
        The end of the domain, as text.
    value
        The speed at which the car is unsafe then.
    """

    name: str
    text: str
    value: float


class PermitSearch:
    """The search for the greatest value of a parameter, such as the speed, up to which each car is
    safe.

    Attributes
    ----------
    span
        The parameter and its range.
    values
        The grid of values at which all cars are driven, in ascending order.
    listed
        The values of tests that are only driven at listed values. Nothing is known between these
        values, so `safe_value` is one of them.
    attacked
        Number of simulations so far that searched for counterexamples.
    least
        Usual number of settings of the searches for counterexamples, of all cars together. With
        fewer settings the question claims no speed.
    """

    def __init__(
        self, models: Models, span: Span, values: FloatArray, budget: int
    ) -> None:
        self.attacked = self.least = 0
        self._models = models
        self.span = span
        self._budget = budget
        ranges = encounters_of(models.own, span)
        self._ranges = {models.own.fit: ranges}
        fixed = [encounters.low for encounters in ranges if encounters.column is None]
        self.listed = np.unique(list(filter(np.isfinite, fixed)))
        is_moved = len(fixed) < len(ranges)
        self.values = np.union1d(values, self.listed) if is_moved else self.listed
        self._models_in_order = list(models.members)
        self._usual = 0.0
        """Usual number of settings of a car in all parameter sets."""

    def phases(self, cars: Sequence[Cars], *, with_repairs: bool) -> NamedValues:
        """The phases of progress, each with its usual number of settings."""
        members = self._models.members
        # Each simulation drives one test, but a setting counts a simulation of every test case:
        # hence the numbers are divided by the number of test cases.
        points = len(members[0].evaluator.system.points)
        vehicles = sum(car.together for car in cars)
        places = len(self.values) * USUAL_PLACES
        searched = len(cars) * self._budget
        self.least = len(members) * searched // points
        of_set = (vehicles * places + searched) / points
        of_sets = len(members) * of_set
        self._usual = of_sets / len(cars)
        phases = {self._stage(model.fit): of_set for model in members}
        return phases | ({REPAIR_STAGE: of_sets} if with_repairs else {})

    def _stage(self, fit: int) -> str:
        return (
            f"cars in parameter set {fit}" if len(self._models.members) > 1 else "cars"
        )

    def reach(
        self, cars: Sequence[Cars], floors: Sequence[float | None], stage: str = ""
    ) -> list[Permit]:
        """Search how far each car is safe in each parameter set. The result of a car does not
        depend on the other cars of the call.

        Parameters
        ----------
        cars
            The cars.
        floors
            For each car None, or a floor. With a floor, only the least value over all sets is of
            interest, and only if it is above the floor. Then a car is driven up to the least value
            of the sets before, and in no further set once this value is not above the floor.
        stage
            The phase of progress; by default the phase of each parameter set.
        """
        permits = [Permit([]) for _ in cars]
        top = float(self.values[-1])
        for model in self._models_in_order:
            fit = model.fit
            # The cars that are still of interest, and the greatest value that is of interest.
            caps = {}
            for car, (permit, floor) in enumerate(zip(permits, floors, strict=True)):
                cap = permit.order if permit.reached and floor is not None else top
                if floor is None or not permit.reached or cap > floor:
                    caps[car] = cap
            if not caps:
                break
            if fit not in self._ranges:
                self._ranges[fit] = encounters_of(model, self.span)
            name = stage or self._stage(fit)
            search = SpeedSearch(
                self._ranges[fit],
                [cars[car] for car in caps],
                self.values,
                list(caps.values()),
                name,
            )
            with model.evaluator.phases.stage(name):
                search.drive_grid()
                if self._budget:
                    search.attack(self._budget)
            self.attacked += search.attacked
            for number, car in enumerate(caps):
                safe_value = search.safe_value(number)
                # Between listed values nothing is known: the last safe listed value counts.
                values = self.listed[self.listed <= (safe_value or -np.inf)]
                safe_value = max(values.tolist(), default=safe_value)
                reached = Reached(fit, safe_value, search.failures[number])
                permits[car].reached.append(reached)
        return permits

    def worst_end(
        self,
        vehicle: CharacteristicSet,
        car: Cars,
        is_measured: BoolArray,
        permit: Permit,
    ) -> WorstEnd | None:
        """The assumed value that lowers the car's speed most at an end of its domain.

        The result is None if all values are measured, if the car is safe at no speed, or if no end
        lowers the speed on the grid.
        """
        top = permit.safe_value
        if top is None or is_measured.all():
            return None

        # Each vehicle has one assumed value at one end of its domain, and all other values as in
        # the failure that limits the car. Only speeds up to the car's own can be lowered: the grid
        # up to this speed is enough. Only the parameter set that limits the car is driven, because
        # a failure in one set is enough.
        limiting = permit.least.failure
        worst = car.lower if limiting is None else limiting.setting[: len(vehicle)]
        is_assumed = np.diag(~is_measured)[~is_measured]
        at_lower = np.where(is_assumed, vehicle.lower, worst)
        at_upper = np.where(is_assumed, vehicle.upper, worst)
        ranges = self._ranges[permit.least.fit]
        search = SpeedSearch(
            [encounters for encounters in ranges if encounters.low <= top],
            [Cars(worst, worst, np.vstack([at_lower, at_upper]))],
            self.values[self.values <= top],
            [top],
            ENDS_STAGE,
        )
        search.drive_grid()
        (failure,) = search.failures
        if failure is None:
            return None
        changed = np.flatnonzero(failure.setting[: len(vehicle)] != worst)
        if not len(changed):
            return None
        item = vehicle.members[changed[0]]
        value = failure.setting[changed[0]]
        return WorstEnd(item.name, f"{value:{EXACT}}{item.suffix}", failure.value)

    def repair_first(
        self,
        cars: Sequence[Cars],
        worn: BoolArray,
        original: FloatArray,
        permits: Sequence[Permit],
    ) -> list[Repaired]:
        """For each of K cars, find the repair that raises its speed most. A repair sets one of the
        `worn` characteristics, shape (K, n), to its value in the `original`, shape (n,).

        A repair has an upper bound of the speed that it can reach. The bound becomes lower when the
        repaired car fails in an encounter that limits the car, or that limits another repair of the
        car. The repair with the largest bound is driven next. No repair is driven whose bound is
        not above the best speed so far.
        """
        # The parameter sets that limit most cars are driven first, because they lower values most.
        limiting = Counter(permit.least.fit for permit in permits)
        self._models_in_order.sort(key=lambda model: -limiting[model.fit])
        top = float(self.values[-1])
        bounds = []
        failures = [permit.limiting for permit in permits]
        best = list[Repaired]([None] * len(cars))
        # The speed of each car with its best repair so far; at first, the speed without a repair.
        orders = [permit.order for permit in permits]
        for row, permit in enumerate(permits):
            columns = np.flatnonzero(worn[row] & (permit.order < top)).tolist()
            bounds.append(dict.fromkeys(columns, np.inf))
        phases = self._models.own.evaluator.phases
        with phases.stage(REPAIR_STAGE):
            while any(bounds):
                phases.expect(self._usual * sum(map(len, bounds)))
                self._lower(
                    bounds,
                    failures,
                    cars,
                    original,
                )
                # Choose the repair with the largest bound for each car, and drop all repairs that
                # cannot be better than the best one so far.
                chosen = {}
                for row, of_car in enumerate(bounds):
                    promising = {
                        column: bound
                        for column, bound in of_car.items()
                        if bound > orders[row]
                    }
                    if promising:
                        chosen[row] = max(promising, key=promising.__getitem__)
                        del promising[chosen[row]]
                    bounds[row] = promising
                repaired = [
                    cars[row].with_value_of(column, original)
                    for row, column in chosen.items()
                ]
                floors = [orders[row] for row in chosen]
                driven = self.reach(repaired, floors, REPAIR_STAGE) if repaired else []
                for (row, column), permit in zip(chosen.items(), driven, strict=True):
                    if permit.order > orders[row]:
                        best[row] = column, permit
                        orders[row] = permit.order
                    failures[row] = permit.failures
        return best

    def _lower(
        self,
        bounds: Sequence[dict[int, float]],
        failures: Sequence[Sequence[LimitingFailure]],
        cars: Sequence[Cars],
        original: FloatArray,
    ) -> None:
        """Lower the upper bounds of repairs. Each repaired car drives in the encounters of
        `failures`, in which its car or another repair of its car failed. A repaired car that fails,
        too, can reach only the next lower value of the grid.

        `bounds` has, for each car, the upper bound by the column of the repair; it is changed.
        """
        repairs = dict[int, list[tuple[int, int, LimitingFailure, FloatArray]]]()
        for row, of_car in enumerate(bounds):
            for failure, column in product(failures[row], of_car):
                repaired = cars[row].with_value_of(column, original)
                setting = failure.setting.copy()
                vehicle = setting[: len(original)]
                np.clip(vehicle, repaired.lower, repaired.upper, out=vehicle)
                of_range = repairs.setdefault(id(failure.encounters), [])
                of_range.append((row, column, failure, setting))
        for of_range in repairs.values():
            encounters = of_range[0][2].encounters
            settings = np.array([setting for *_, setting in of_range])
            is_unsafe = encounters.robustness(settings, REPAIR_STAGE) < 0
            for row, column, failure, _ in compress(of_range, is_unsafe):
                values = self.values[self.values < failure.value].tolist()
                bound = max(values, default=-np.inf)
                bounds[row][column] = min(bounds[row][column], bound)


def cars_of(vehicle: CharacteristicSet, fleet: Fleet) -> list[Cars]:
    """The cars of a list. A measured value becomes the range of values that it may really have."""
    cars = []
    for setting, is_measured in zip(fleet.settings, fleet.measured, strict=True):
        ends = list(map(Characteristic.measured, vehicle, setting))
        lower, upper = np.where(is_measured, np.transpose(ends), setting)
        cars.append(Cars.measured(lower, upper))
    return cars
