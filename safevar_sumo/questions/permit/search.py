"""The greatest speeds of cars in all parameter sets, and the repair that raises a speed most."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import compress, product
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.models import Models
from safevar_sumo.questions.permit.encounters import Span, encounters_of
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.speeds import Cars, LimitingFailure, SpeedSearch
from safevar_sumo.questions.words import EXACT
from safevar_sumo.records import BoolArray, FloatArray, NamedValues
from safevar_sumo.vehicles import CharacteristicSet

REPAIR_STAGE = "cars with one part as new"
ENDS_STAGE = "cars with assumed values at ends of their domains"
USUAL_PLACES = 100
"""Usual number of encounters of a vehicle at a speed, those of all tests at all their phases."""
MOST_LIMITING = 3
"""Number of failures of a car that each repair of it meets first."""


class Reached(NamedTuple):
    """How far a car is safe in a parameter set: the greatest value, None if it is not safe at the
    least; and the failure that limits it, if one was found.
    """

    fit: int
    up_to: float | None
    failure: LimitingFailure | None

    @property
    def order(self) -> float:
        """What decides which of two values is greater: None, of a car that is not safe at all, is
        the least.
        """
        return -np.inf if self.up_to is None else self.up_to


class Permit(NamedTuple):
    """What is known of a car: how far it is safe in each parameter set."""

    reached: list[Reached]

    @property
    def least(self) -> Reached:
        """The parameter set that limits it most."""
        return min(self.reached, key=lambda reached: reached.order)

    @property
    def up_to(self) -> float | None:
        return self.least.up_to

    @property
    def failures(self) -> list[LimitingFailure]:
        """The failure that limits it in each parameter set in which one was found."""
        return [
            reached.failure for reached in self.reached if reached.failure is not None
        ]

    @property
    def limiting(self) -> list[LimitingFailure]:
        """Those at the least values."""
        ordered = sorted(self.failures, key=lambda failure: failure.value)
        return ordered[:MOST_LIMITING]

    @property
    def order(self) -> float:
        return self.least.order


Repaired = tuple[int, Permit] | None
"""The column of the characteristic that raises a car's value most, and the car as it is then."""


class WorstEnd(NamedTuple):
    """The assumed value of a car that lowers its speed most at an end of its domain: the name of
    the characteristic, the end as text, and the value at which the car is unsafe then.
    """

    name: str
    text: str
    value: float


class PermitSearch:
    """The search for the greatest values of a parameter up to which cars are safe.

    Attributes
    ----------
    values, span
        The values of the grid, and the parameter.
    listed
        The values of tests that cannot move it: nothing is known between them.
    attacked
        Number of simulations that searched for counterexamples so far.
    least
        Usual number of settings of these searches of all cars: with fewer, no speed is claimed.
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
        self.listed = np.unique([value for value in fixed if np.isfinite(value)])
        is_moved = len(fixed) < len(ranges)
        self.values = np.union1d(values, self.listed) if is_moved else self.listed
        self._models_in_order = [*models.members]
        self._usual = 0.0
        """Usual number of settings of a car in all parameter sets."""

    def phases(self, cars: Sequence[Cars], *, with_repairs: bool) -> NamedValues:
        """The phases of progress, each with its usual number of settings."""
        members = self._models.members
        # Tests are simulated alone, so that settings at all points of a matrix are fewer.
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
        """How far each of the cars is safe, whichever others are asked for with it.

        A car of which only the least value counts, where it is above a floor, is driven no further
        in a parameter set than in those before, and in no further set once it is not.
        """
        permits = [Permit([]) for _ in cars]
        top = float(self.values[-1])
        for model in self._models_in_order:
            # The cars that are still of interest, and how far.
            waiting = list[int]()
            caps = list[float]()
            for car, (permit, floor) in enumerate(zip(permits, floors, strict=True)):
                cap = permit.order if permit.reached and floor is not None else top
                if floor is None or not permit.reached or cap > floor:
                    waiting.append(car)
                    caps.append(cap)
            if not waiting:
                break
            if model.fit not in self._ranges:
                self._ranges[model.fit] = encounters_of(model, self.span)
            name = stage or self._stage(model.fit)
            search = SpeedSearch(
                self._ranges[model.fit],
                [cars[car] for car in waiting],
                self.values,
                caps,
                name,
            )
            with model.evaluator.phases.stage(name):
                search.drive_grid()
                if self._budget:
                    search.attack(self._budget)
            self.attacked += search.attacked
            for number, car in enumerate(waiting):
                up_to = search.up_to(number)
                # The last listed value, if any.
                values = self.listed[self.listed <= (up_to or -np.inf)]
                up_to = max(values.tolist(), default=up_to)
                reached = Reached(model.fit, up_to, search.failures[number])
                permits[car].reached.append(reached)
        return permits

    def worst_end(
        self,
        vehicle: CharacteristicSet,
        car: Cars,
        is_measured: BoolArray,
        permit: Permit,
    ) -> WorstEnd | None:
        """The worst end of a car; None where nothing is assumed, the car may not drive as it is, or
        no end lowers its speed on the grid.
        """
        if permit.up_to is None or is_measured.all():
            return None

        # Each assumed value at either end, all others as they are worst. Any failure shows that
        # the car may drive no faster, so the grid up to its own speed is enough, with the set that
        # limits it.
        limiting = permit.least.failure
        worst = car.lower if limiting is None else limiting.setting[: len(vehicle)]
        is_assumed = np.eye(len(vehicle), dtype=bool)[~is_measured]
        sides = [
            np.where(is_assumed, end, worst) for end in (vehicle.lower, vehicle.upper)
        ]
        ranges = self._ranges[permit.least.fit]
        search = SpeedSearch(
            [encounters for encounters in ranges if encounters.low <= permit.up_to],
            [Cars(worst, worst, np.vstack(sides))],
            self.values[self.values <= permit.up_to],
            [permit.up_to],
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
        """For each of K cars the characteristic among its `worn` ones, shape (K, n), that, as in
        the original, raises its value most, with the car as it is then; None where no single one
        does.

        A repaired car first meets the encounters that limit the car, or another repair: what it
        could reach at most decides which repair is driven next, and whether another one is at all.
        """
        # First the parameter sets that limit most cars.
        limiting = Counter(permit.least.fit for permit in permits)
        self._models_in_order.sort(key=lambda model: -limiting[model.fit])
        top = float(self.values[-1])
        bounds = list[dict[int, float]]()
        failures = list[list[LimitingFailure]]()
        best = list[Repaired]([None] * len(cars))
        # With the best repair so far.
        orders = [permit.order for permit in permits]
        for row, permit in enumerate(permits):
            columns = np.flatnonzero(worn[row] & (permit.order < top)).tolist()
            bounds.append(dict.fromkeys(columns, np.inf))
            failures.append(permit.limiting)
        with self._models.own.evaluator.phases.stage(REPAIR_STAGE) as expect:
            while any(bounds):
                expect(self._usual * sum(map(len, bounds)))
                self._lower(
                    bounds,
                    failures,
                    cars,
                    original,
                )
                # The most promising repair of each car, unless a better one is known.
                chosen = dict[int, int]()
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
        """Lower what each repair could reach at most, by the failures of other cars that it does
        not avoid.
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
    """The cars of a list, with all values that their measured ones may really have."""
    ends = np.array(
        [
            [item.measured(value) for item, value in zip(vehicle, setting, strict=True)]
            for setting in fleet.settings
        ]
    )
    ends = np.where(
        fleet.measured[..., np.newaxis], ends, fleet.settings[..., np.newaxis]
    )
    return [Cars.measured(*car.T) for car in ends]
