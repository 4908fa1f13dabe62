"""The search, with one parameter set, for the greatest value of a parameter (such as the speed) up
to which each of several cars is safe.

First, all cars drive in the encounters of a grid of values. Then a search for counterexamples
covers all encounters of each car up to the value that the grid gave. The search does not assume
that a car is safer at lower values: one failure at 33 km/h means "up to 32".

A case is a row of n + 1 + 1 + k numbers: a vehicle (n values), the number of a test, the value of
the parameter in its unit, and k shares of the ranges of other axes, from 0 to 1. The last k + 1
numbers are a place.
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
"""Least number of values of the grid in a block. After each block, cars that failed are left out. A
block has more values if there are few cars.
"""
EFFICIENT = 512
"""Number of vehicles times values that fill a batch. A smaller batch costs hardly less."""
GENERATION = 512
MORE = 1
"""Number of cases in a generation of the search for counterexamples, and number of generations that
follow the first generation with an unsafe case.
"""
SPREAD = 128
"""Number of vehicles at Sobol points that stand for all vehicles within limits; as many vehicles at
corners are added.
"""


class Cars(NamedTuple):
    """All vehicles between two ends. They are one car, whose values are known only up to errors of
    measurement, or all cars within limits.

    Attributes
    ----------
    lower, upper
        The least and the greatest value of each characteristic of the vehicle, shape (n,).
    vehicles
        The vehicles that drive in the encounters of the grid, shape (V, n).
    """

    lower: FloatArray
    upper: FloatArray
    vehicles: FloatArray

    @classmethod
    def one(cls, values: FloatArray) -> Cars:
        """A car whose characteristics have exactly these values, shape (n,)."""
        return cls(values, values, values[np.newaxis])

    @classmethod
    def measured(cls, lower: FloatArray, upper: FloatArray) -> Cars:
        """A car whose values are between `lower` and `upper`. Vehicles at its corners (each value
        at an end) drive in the grid: all corners, or up to `SPREAD` of them if there are more.
        """
        corners = np.round(sobol_points(SPREAD, len(lower), seed=0))
        vehicles = np.where(corners == 0, lower, upper)
        return cls(lower, upper, np.unique(vehicles, axis=0))

    @classmethod
    def within(cls, lower: FloatArray, upper: FloatArray, seed: int) -> Cars:
        """All cars within limits. Vehicles at Sobol points, and as many at corners, drive in the
        grid.
        """
        points = sobol_points(SPREAD, len(lower), seed)
        points = np.concatenate([np.round(points), points])
        vehicles = lower + points * (upper - lower)
        return cls(lower, upper, np.unique(vehicles, axis=0))

    def with_value_of(self, column: int, model: FloatArray) -> Cars:
        """The same car, with the value of one column as in the `model` vehicle, shape (n,)."""
        fields = [values.copy() for values in self]
        for values in fields:
            values[..., column] = model[column]
        lower, upper, vehicles = fields
        return Cars(lower, upper, np.unique(vehicles, axis=0))

    @property
    def together(self) -> int:
        """The number of vehicles that drive in each encounter of the grid."""
        return min(len(self.vehicles), MOST_VEHICLES)

    def at(self, place: FloatArray) -> FloatArray:
        """The vehicles that drive in one encounter of the grid, shape (`together`, n). If there are
        more vehicles, other ones are drawn for each encounter, and half of them are at corners.
        """
        if len(self.vehicles) == self.together:
            return self.vehicles
        rng = np.random.default_rng([self.number, zlib.crc32(place.tobytes())])
        vehicles = rng.permutation(self.vehicles)
        is_corner = np.isin(vehicles, [self.lower, self.upper]).all(axis=1)
        corners = vehicles[is_corner]
        half = self.together // 2
        ordered = np.vstack([corners[:half], vehicles[~is_corner], corners[half:]])
        return ordered[: self.together]

    @property
    def number(self) -> int:
        """A seed of random numbers for these cars. The seed depends on the ends alone, and not on
        other cars of the same question.
        """
        return zlib.crc32(np.concatenate([self.lower, self.upper]).tobytes())


class LimitingFailure(NamedTuple):
    """The unsafe encounter at the least value of the parameter at which a car was found to fail.

    Attributes
    ----------
    value
        The value of the parameter.
    encounters
        The encounters of the test in which the car failed.
    setting
        The vehicle and its encounter, shape (n + number of encounter values,).
    robustness
        The distance to the criterion's limit, which is below 0.
    """

    value: float
    encounters: EncounterRange
    setting: FloatArray
    robustness: float


class SpeedSearch:
    """The search with one parameter set. Each car has a cap: the greatest value that is of
    interest, above which the car is not driven.

    Attributes
    ----------
    failures
        The limiting failure of each car; None for a car without a known failure.
    attacked
        Number of simulations of the search for counterexamples.
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
        # Sorted by their least values, the tests that exist up to a value have the first numbers.
        self._ranges = sorted(ranges, key=lambda encounters: encounters.low)
        self._cars = cars
        self._values = values
        self._caps = caps
        self._stage = stage
        self._size = len(cars[0].lower)
        members = [encounters.model.characteristics for encounters in ranges]
        self._axes = max(map(len, members)) - self._size
        self._judged: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in cars]

    def safe_value(self, car: int) -> float | None:
        """The greatest value of the grid below the limiting failure of a car, and not above its
        cap. The result is None if the car fails at the least value.
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
        """Simulate all cars in the encounters of the grid, from low values to high values. A car
        ends with the first block of values in which it fails.
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
                ends = np.cumsum(list(map(len, cases)))[:-1]
                parts = np.split(self._judge(np.concatenate(cases)), ends)
                for car, of_car, robustness in zip(alive, cases, parts, strict=True):
                    self._note(car, of_car, robustness)

    def _places(self, block: FloatArray) -> FloatArray:
        """The encounters of all tests at the values of a block: the number of the test, the value,
        and k shares of other axes, shape (P, 2 + k).

        The least value of a test may not be a value of the grid, and may be the only value of the
        test. Therefore the least value is driven in the block of the next value of the grid.
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
                # A test with fewer axes than another one ignores the last shares.
                padding = 1 + self._axes - places.shape[1]
                rows.append(np.pad(places, ((0, 0), (1, padding))))
                rows[-1][:, 0] = number
        return np.concatenate(rows)

    def _cases(self, car: int, places: FloatArray) -> FloatArray:
        """The cases of a car in P encounters, shape (P, 2 + k): in each, `together` vehicles of the
        car. The result has shape (P * together, n + 2 + k).
        """
        cars = self._cars[car]
        vehicles = np.concatenate(list(map(cars.at, places)))
        return np.hstack([vehicles, np.repeat(places, cars.together, axis=0)])

    def _judge(self, cases: FloatArray) -> FloatArray:
        """The robustness of each of M cases, shape (M,): below 0 the case is unsafe."""
        robustness = np.zeros(len(cases))
        for encounters, rows, settings in self._in_tests(cases):
            robustness[rows] = encounters.robustness(settings, self._stage)
        return robustness

    def _in_tests(
        self, cases: FloatArray
    ) -> Iterator[tuple[EncounterRange, IntArray, FloatArray]]:
        """For each test in which some of M cases drive: the encounters of the test, the rows of
        these cases, and the settings of these cases.
        """
        numbers = np.floor(cases[:, self._size]).astype(int)
        for number in np.unique(numbers).tolist():
            rows = np.flatnonzero(numbers == number)
            vehicles, places = np.split(cases[rows], [self._size], axis=1)
            encounters = self._ranges[number]
            yield encounters, rows, encounters.settings(vehicles, places[:, 1:])

    def _note(self, car: int, cases: FloatArray, robustness: FloatArray) -> bool:
        """Store the cases of a car with their robustness, and update its limiting failure: the
        failure at the least value, and of several failures there the worst. Returns whether a case
        is unsafe.
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
        """Search for counterexamples to the value of each car. A counterexample lowers the value to
        a value of the grid, and the search begins anew with the whole `budget` of cases, until it
        finds no unsafe case.
        """
        attempt = 0
        waiting = self._open(range(len(self._cars)))
        while waiting:
            attempt += 1
            # Search all cars side by side. The search of a car begins with its worst cases so far.
            searches = [self._search(car, budget, attempt) for car in waiting]
            results = search_side_by_side(self._judge, searches)
            self.attacked += sum(result.simulated for result in results)
            waiting = self._open(
                car
                for car, result in zip(waiting, results, strict=True)
                if self._note(car, result.cases, result.robustness)
            )

    def _open(self, cars: Iterable[int]) -> list[int]:
        """Those of the cars for which a search can find something new: a car is safe at some value,
        and its encounters have axes, or it stands for several vehicles.
        """
        return [
            car
            for car in cars
            if self.safe_value(car) is not None
            and (self._axes or len(self._cars[car].vehicles) > 1)
        ]

    def _search(self, car: int, budget: int, attempt: int) -> Generations:
        """The search for counterexamples to the value of a car. `attempt` counts the searches of
        the car, and is a part of the seed.
        """
        safe_value = self.safe_value(car)
        cars = self._cars[car]
        assert safe_value is not None
        # Only tests that exist at the car's value or below are searched.
        number = sum(encounters.low <= safe_value for encounters in self._ranges)
        shares = np.zeros(self._axes)
        first_place = [0.0, self._values[0]]
        last_place = [np.nextafter(number, 0), safe_value]
        lower = np.concatenate([cars.lower, first_place, shares])
        upper = np.concatenate([cars.upper, last_place, shares + 1])
        space = Space(lower, upper, self._size)

        # The search begins with the worst cases so far that are in the searched space.
        cases, robustness = map(np.concatenate, zip(*self._judged[car], strict=True))
        is_inside = (cases >= space.lower) & (cases <= space.upper)
        robustness = np.where(is_inside.all(axis=1), robustness, np.inf)
        worst = np.argsort(robustness, kind="stable")[:PARENTS]
        starts = cases[worst[np.isfinite(robustness[worst])]]
        fit = self._ranges[0].model.fit
        rng = Stream.PERMIT.generator(cars.number, fit, attempt)
        return generations_of(space, starts, SearchPlan(budget, GENERATION, MORE), rng)
