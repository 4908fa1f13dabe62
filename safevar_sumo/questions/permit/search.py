"""The greatest speeds of cars in all parameter sets, and the repair that raises a speed most."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.models import Models
from safevar_sumo.questions.permit import words
from safevar_sumo.questions.permit.encounters import Span, encounters_of
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.speeds import Cars, LimitingFailure, SpeedSearch
from safevar_sumo.questions.sentence import Sentence
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

    reached: Sequence[Reached]

    @property
    def least(self) -> Reached:
        """The parameter set that limits it most."""
        return min(self.reached, key=lambda each: each.order)

    @property
    def up_to(self) -> float | None:
        return self.least.up_to

    @property
    def failures(self) -> list[LimitingFailure]:
        """The failure that limits it in each parameter set in which one was found."""
        return [each.failure for each in self.reached if each.failure is not None]

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
        fixed = [each.low for each in ranges if each.column is None]
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
        each = (vehicles * places + searched) / points
        self._usual = len(members) * each / len(cars)
        phases = {self._stage(model.fit): each for model in members}
        return phases | ({REPAIR_STAGE: len(members) * each} if with_repairs else {})

    def _stage(self, fit: int) -> str:
        return (
            f"cars in parameter set {fit}" if len(self._models.members) > 1 else "cars"
        )

    def reach(
        self, cars: Sequence[Cars], above: Sequence[float | None], stage: str = ""
    ) -> list[Permit]:
        """How far each of the cars is safe, whichever others are asked for with it.

        A car of which only the least value counts, where it is `above` one, is driven no further
        in a parameter set than in those before, and in no further set once it is not.
        """
        found = list[list[Reached]]([] for _ in cars)
        top = float(self.values[-1])
        for model in self._models_in_order:
            # The cars that are still of interest, and how far.
            permits = [Permit(reached) for reached in found]
            waiting = [
                car
                for car, permit in enumerate(permits)
                if not permit.reached
                or (least := above[car]) is None
                or permit.order > least
            ]
            caps = [
                permits[car].order if found[car] and above[car] is not None else top
                for car in waiting
            ]
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
                up_to = self._driven(search.up_to(number))
                found[car].append(Reached(model.fit, up_to, search.failures[number]))
        return [Permit(reached) for reached in found]

    def _driven(self, up_to: float | None) -> float | None:
        """The last listed value up to one, if any."""
        below = self.listed[self.listed <= (up_to or -np.inf)]
        return max(below.tolist(), default=up_to)

    def worst_end(self, cars: Cars, permit: Permit) -> LimitingFailure | None:
        """The failure at the least value, up to that of a permit, of cars that drive the grid with
        the parameter set that limits the permit; None where none fails.
        """
        up_to = permit.order
        driven = [each for each in self._ranges[permit.least.fit] if each.low <= up_to]
        values = self.values[self.values <= up_to]
        search = SpeedSearch(
            driven,
            [cars],
            values,
            [up_to],
            ENDS_STAGE,
        )
        search.drive_grid()
        return search.failures[0]

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
        known = [permit.order for permit in permits]  # with the best repair so far
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
                    for column in [
                        column for column, most in of_car.items() if most <= known[row]
                    ]:
                        del of_car[column]
                    if of_car:
                        chosen[row] = max(of_car, key=of_car.__getitem__)
                        del of_car[chosen[row]]
                repaired = [
                    cars[row].with_value_of(column, original)
                    for row, column in chosen.items()
                ]
                above = [known[row] for row in chosen]
                driven = self.reach(repaired, above, REPAIR_STAGE) if repaired else []
                for (row, column), permit in zip(chosen.items(), driven, strict=True):
                    if permit.order > known[row]:
                        best[row] = column, permit
                        known[row] = permit.order
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
        rows = dict[int, list[tuple[int, int, float, FloatArray]]]()
        ranges = {id(each): each for of_fit in self._ranges.values() for each in of_fit}
        for row, of_car in enumerate(bounds):
            for failure in failures[row]:
                for column in of_car:
                    repaired = cars[row].with_value_of(column, original)
                    setting = failure.setting.copy()
                    vehicle = setting[: len(original)]
                    np.clip(
                        vehicle,
                        repaired.lower,
                        repaired.upper,
                        out=vehicle,
                    )
                    rows.setdefault(id(failure.encounters), []).append(
                        (row, column, failure.value, setting)
                    )
        for number, of_range in rows.items():
            driven = np.array([setting for _, _, _, setting in of_range])
            robustness = ranges[number].robustness(driven, REPAIR_STAGE)
            for (row, column, value, _), left in zip(
                of_range, robustness.tolist(), strict=True
            ):
                if left < 0:
                    below = self.values[self.values < value].tolist()
                    most = max(
                        below,
                        default=-np.inf,
                    )
                    bounds[row][column] = min(bounds[row][column], most)


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


class WorstEnd(NamedTuple):
    """The assumed value of a car that lowers its speed most at an end of its domain: the name of
    the characteristic, the end as text, and the value at which the car is unsafe then.
    """

    name: str
    text: str
    value: float

    def sentence(self, span: Span) -> Sentence:
        """That this value matters most."""
        value = span.text(max(self.value, span.low))
        return words.WORST_END(
            end=f"{self.name} {self.text}",
            value=value,
        )


def worst_end(
    search: PermitSearch,
    vehicle: CharacteristicSet,
    car: Cars,
    is_measured: BoolArray,
    permit: Permit,
) -> WorstEnd | None:
    """The worst end of a car; None where nothing is assumed, the car may not drive as it is, or no
    end lowers its speed on the grid.
    """
    if permit.up_to is None or is_measured.all():
        return None

    # Each assumed value at either end, all others as they are worst. Any failure shows that the car
    # may drive no faster, so the grid up to its own speed is enough, with the set that limits it.
    limiting = permit.least.failure
    own = car.lower if limiting is None else limiting.setting[: len(vehicle)]
    is_one = np.eye(len(vehicle), dtype=bool)[~is_measured]
    sides = [np.where(is_one, end, own) for end in (vehicle.lower, vehicle.upper)]
    failure = search.worst_end(Cars(own, own, np.vstack(sides)), permit)
    worst = own if failure is None else failure.setting[: len(vehicle)]
    if failure is None or (worst == own).all():
        return None
    column = np.argmax(worst != own)
    item = vehicle.members[column]
    return WorstEnd(item.name, f"{worst[column]:{EXACT}}{item.suffix}", failure.value)
