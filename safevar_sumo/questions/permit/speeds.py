"""The search for the greatest value of a parameter, such as the speed, up to which each of several
cars is safe with one parameter set.

First all cars meet the encounters of a grid. Then the encounters up to what was found for each of
them are searched for counterexamples. Nothing is assumed to be monotone: one failure at 33 km/h
means "up to 32".
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.cases import (
    PARENTS,
    Generations,
    SearchPlan,
    Space,
    generations_of,
    search_side_by_side,
)
from safevar_sumo.questions.permit.encounters import MOST_VEHICLES, EncounterRange
from safevar_sumo.questions.sampling import Stream, sobol_points
from safevar_sumo.records import FloatArray, IntArray

BLOCK = 8
"""Number of values of the grid that cars meet before those that failed are left out; more for few
cars.
"""
EFFICIENT = 512
"""Number of cars times values that fill a batch: a smaller one costs hardly less."""
GENERATION = 512
MORE = 1
"""Number of cases of a generation of the search for counterexamples, and the generations that
follow the first with an unsafe case.
"""
SPREAD = 128
"""Number of cars that stand for all within limits, beside those at their corners."""


class Cars(NamedTuple):
    """A car, with all values that its measured ones may really have, or all cars within limits.

    Attributes
    ----------
    lower, upper
        The least and greatest values of the vehicle's characteristics, shape (n,).
    vehicles
        The cars that meet the encounters of the grid, shape (V, n).
    """

    lower: FloatArray
    upper: FloatArray
    vehicles: FloatArray

    @classmethod
    def one(cls, values: FloatArray) -> Cars:
        """A car with these values of its characteristics."""
        return cls(values, values, values[np.newaxis])

    @classmethod
    def measured(cls, lower: FloatArray, upper: FloatArray) -> Cars:
        """A car whose values are between these: those at all ends drive the grid, or of many at
        some.
        """
        corners = np.round(sobol_points(SPREAD, len(lower), seed=0))
        return cls(
            lower, upper, np.unique(np.where(corners == 0, lower, upper), axis=0)
        )

    @classmethod
    def within(cls, lower: FloatArray, upper: FloatArray, seed: int) -> Cars:
        """All cars within limits: those at Sobol points and at as many corners drive the grid."""
        points = sobol_points(SPREAD, len(lower), seed)
        points = np.concatenate([np.round(points), points])
        return cls(lower, upper, np.unique(lower + points * (upper - lower), axis=0))

    def with_value_of(self, column: int, model: FloatArray) -> Cars:
        """A car with one of its values as in a model, such as the original."""
        fields = [values.copy() for values in self]
        for values in fields:
            values[..., column] = model[column]
        lower, upper, vehicles = fields
        return Cars(lower, upper, np.unique(vehicles, axis=0))

    @property
    def together(self) -> int:
        """How many of the vehicles meet an encounter of the grid."""
        return min(len(self.vehicles), MOST_VEHICLES)

    def at(self, place: FloatArray) -> FloatArray:
        """The vehicles that meet an encounter of the grid; of many, others at each, and half of
        them at corners.
        """
        if len(self.vehicles) == self.together:
            return self.vehicles
        rng = np.random.default_rng([self.number, zlib.crc32(place.tobytes())])
        vehicles = rng.permutation(self.vehicles)
        is_corner = np.isin(vehicles, [self.lower, self.upper]).all(axis=1)
        corners = vehicles[is_corner]
        half = self.together // 2
        return np.vstack([corners[:half], vehicles[~is_corner], corners[half:]])[
            : self.together
        ]

    @property
    def number(self) -> int:
        """A number by which random numbers of these cars are drawn: it does not depend on others
        that are asked for with them.
        """
        return zlib.crc32(np.concatenate([self.lower, self.upper]).tobytes())


class LimitingFailure(NamedTuple):
    """The unsafe encounter at the least value of the parameter that was found: the value, the test,
    the setting, shape (n,), and what it leaves to the limit.
    """

    value: float
    encounters: EncounterRange
    setting: FloatArray
    robustness: float


class SpeedSearch:
    """The search with one parameter set.

    Attributes
    ----------
    failures
        The limiting failure of each of the cars; None where none was found.
    attacked
        Number of simulations of the search for counterexamples.

    A car is driven no further than up to its cap, the greatest value that is of interest. A case is
    a vehicle, the number of a test, and a place in its encounters.
    """

    def __init__(
        self,
        ranges: Sequence[EncounterRange],
        cars: Sequence[Cars],
        values: FloatArray,
        caps: Sequence[float],
        stage: str,
    ) -> None:
        self.failures: list[LimitingFailure | None] = [None] * len(cars)
        self.attacked = 0
        # The tests that go on up to some value are the first ones.
        self._ranges = sorted(ranges, key=lambda encounters: encounters.low)
        self._cars = cars
        self._values = values
        self._caps = caps
        self._stage = stage
        self._size = len(cars[0].lower)
        members = [encounters.model.characteristics for encounters in ranges]
        self._axes = max(map(len, members)) - self._size
        self._judged: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in cars]

    def up_to(self, car: int) -> float | None:
        """The greatest value of the grid below the limiting failure of a car, at most its cap; None
        if it fails at the least.
        """
        failure = self.failures[car]
        is_safe = self._values <= self._caps[car]
        if failure is not None:
            is_safe &= self._values < failure.value
        return max(
            self._values[is_safe].tolist(),
            default=None,
        )

    def drive_grid(self) -> None:
        """Have all cars meet the encounters of the grid, from low values to high ones, each up to
        the first block in which it fails.
        """
        values = self._values
        while len(values):
            alive = [
                car
                for car, failure in enumerate(self.failures)
                if failure is None and values[0] <= self._caps[car]
            ]
            vehicles = sum(self._cars[car].together for car in alive)
            size = max(BLOCK, EFFICIENT // max(vehicles, 1))
            places = self._places(values[:size])
            values = values[size:]
            if alive and len(places):
                cases = [self._cases(car, places) for car in alive]
                ends = np.cumsum([*map(len, cases)])[:-1]
                parts = np.split(self._judge(np.concatenate(cases)), ends)
                for car, of_car, robustness in zip(alive, cases, parts, strict=True):
                    self._note(car, of_car, robustness)

    def _places(self, block: FloatArray) -> FloatArray:
        """The numbers of tests, and their places at the values of a block, shape (P, 2 + k). The
        least value of a test, which may be its only one, is driven with the next value of the grid.
        """
        rows = [np.zeros((0, 2 + self._axes))]
        for number, encounters in enumerate(self._ranges):
            begin = max(encounters.low, self._values[0])
            next_value = self._values[np.searchsorted(self._values, begin)]
            values = [begin] if next_value in block else []
            if encounters.column is not None:
                values += block[
                    (block > encounters.low) & (block <= encounters.high)
                ].tolist()
            for value in values:
                places = encounters.places(value)
                padding = 1 + self._axes - places.shape[1]
                rows.append(np.pad(places, ((0, 0), (1, padding))))
                rows[-1][:, 0] = number
        return np.concatenate(rows)

    def _cases(self, car: int, places: FloatArray) -> FloatArray:
        """The vehicles of a car at places, some of them at each."""
        cars = self._cars[car]
        vehicles = np.concatenate([cars.at(place) for place in places])
        return np.hstack([vehicles, np.repeat(places, cars.together, axis=0)])

    def _judge(self, cases: FloatArray) -> FloatArray:
        """What each of M cases leaves to the limit, shape (M,)."""
        robustness = np.zeros(len(cases))
        for encounters, rows, settings in self._in_tests(cases):
            robustness[rows] = encounters.robustness(settings, self._stage)
        return robustness

    def _in_tests(
        self, cases: FloatArray
    ) -> Iterator[tuple[EncounterRange, IntArray, FloatArray]]:
        """The tests that cases meet, each with their rows and their settings there."""
        numbers = np.floor(cases[:, self._size]).astype(int)
        for number in np.unique(numbers).tolist():
            rows = np.flatnonzero(numbers == number)
            vehicles, places = np.split(cases[rows], [self._size], axis=1)
            encounters = self._ranges[number]
            yield encounters, rows, encounters.settings(vehicles, places[:, 1:])

    def _note(self, car: int, cases: FloatArray, robustness: FloatArray) -> bool:
        """Keep what a car met, and its failure at the least value, of several the worst; whether it
        fails.
        """
        self._judged[car].append((cases, robustness))
        unsafe = np.flatnonzero(robustness < 0)
        for encounters, rows, settings in self._in_tests(cases[unsafe]):
            values = encounters.values_in(settings)
            degrees = robustness[unsafe[rows]]
            row = np.lexsort((degrees, values))[0]
            value = float(values[row])
            degree = float(degrees[row])
            former = self.failures[car]
            if former is None or (value, degree) < (former.value, former.robustness):
                self.failures[car] = LimitingFailure(
                    value, encounters, settings[row], degree
                )
        return len(unsafe) > 0

    def attack(self, budget: int) -> None:
        """Search encounters of each car up to its value, with a budget for each, until nothing is
        found. What is found is a value of the grid, at which all tests were driven.
        """
        attempt = 0
        waiting = self._open(range(len(self._cars)))
        while waiting:
            attempt += 1
            # All cars side by side, each from what it met.
            searches = [self._search(car, budget, attempt) for car in waiting]
            results = search_side_by_side(self._judge, searches)
            self.attacked += sum(result.simulated for result in results)
            waiting = self._open(
                car
                for car, result in zip(waiting, results, strict=True)
                if self._note(car, result.cases, result.robustness)
            )

    def _open(self, cars: Iterable[int]) -> list[int]:
        """The cars that are safe at some value, and of which more than one case is not met yet."""
        return [
            car
            for car in cars
            if self.up_to(car) is not None
            and (self._axes or len(self._cars[car].vehicles) > 1)
        ]

    def _search(self, car: int, budget: int, attempt: int) -> Generations:
        """The search for counterexamples to the value of a car."""
        up_to = self.up_to(car)
        cars = self._cars[car]
        assert up_to is not None
        number = sum(encounters.low <= up_to for encounters in self._ranges)
        ends = np.array([np.zeros(2 + self._axes), np.ones(2 + self._axes)])
        ends[:, 0] = 0, np.nextafter(number, 0)
        ends[:, 1] = self._values[0], up_to
        space = Space(
            np.append(cars.lower, ends[0]), np.append(cars.upper, ends[1]), self._size
        )

        # The worst cases so far, up to this value.
        cases, robustness = map(np.concatenate, zip(*self._judged[car], strict=True))
        is_inside = (cases >= space.lower) & (cases <= space.upper)
        robustness = np.where(is_inside.all(axis=1), robustness, np.inf)
        worst = np.argsort(robustness, kind="stable")[:PARENTS]
        starts = cases[worst[np.isfinite(robustness[worst])]]
        fit = self._ranges[0].model.fit
        rng = Stream.PERMIT.generator(cars.number, fit, attempt)
        return generations_of(space, starts, SearchPlan(budget, GENERATION, MORE), rng)
