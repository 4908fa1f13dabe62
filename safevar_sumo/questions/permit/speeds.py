"""The search for the greatest value of a parameter, such as the speed, up to which each of several
cars is safe with one parameter set.

First all cars meet the encounters of a grid. Then a falsification searches the encounters below
what was found for each of them. Nothing is assumed to be monotone: one failure at 33 km/h means "up
to 32".
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import PARENTS, Falsification, falsify_all
from safevar_sumo.questions.permit.encounters import MOST_VEHICLES, EncounterRange
from safevar_sumo.questions.sampling import Stream, sobol_points
from safevar_sumo.records import FloatArray

BLOCK = 8
"""Number of values of the grid that cars meet before those that failed are left out; more for few
cars.
"""
EFFICIENT = 512
"""Number of cars times values that fill a batch: a smaller one costs hardly less."""
GENERATION = 256
"""Number of simulations of a generation of the falsification."""
LEAST_BUDGET = 64
"""Fewest simulations of a falsification of one car in one test."""
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

    def with_value_of(self, column: int, other: FloatArray) -> Cars:
        """A car with one of its values as in another car, such as the original."""
        lower, upper, vehicles = (values.copy() for values in self)
        for values in (lower, upper, vehicles):
            values[..., column] = other[column]
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
        Number of simulations of the falsification.

    A car is driven no further than up to its cap, the greatest value that is of interest.
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
        self._ranges = ranges
        self._cars = cars
        self._values = values
        self._caps = caps
        self._stage = stage
        self._met: list[list[list[tuple[FloatArray, FloatArray]]]] = [
            [[] for _ in ranges] for _ in cars
        ]

    def up_to(self, car: int) -> float | None:
        """The greatest value of the grid below the limiting failure of a car, at most its cap; None
        if it fails at the least.
        """
        failure = self.failures[car]
        is_safe = self._values <= self._caps[car]
        if failure is not None:
            is_safe &= self._values < failure.value
        return float(self._values[is_safe][-1]) if is_safe.any() else None

    def drive_grid(self) -> None:
        """Have all cars meet the encounters of the grid, from low values to high ones, each up to
        the first block in which it fails.
        """
        rest = self._values
        while len(rest):
            alive = [
                car
                for car, found in enumerate(self.failures)
                if found is None and rest[0] <= self._caps[car]
            ]
            vehicles = sum(self._cars[car].together for car in alive)
            size = max(BLOCK, EFFICIENT // max(vehicles, 1))
            block, rest = rest[:size], rest[size:]
            for number, encounters in enumerate(self._ranges):
                places = self._places(encounters, block)
                if places and alive:
                    self._drive(number, alive, np.concatenate(places))

    def _places(
        self, encounters: EncounterRange, block: FloatArray
    ) -> list[FloatArray]:
        """The encounters of a test at the values of a block. The least value of a test, which may
        be its only one, is driven with the next value of the grid.
        """
        begin = max(encounters.low, self._values[0])
        next_value = self._values[np.searchsorted(self._values, begin)]
        values = [begin] if next_value in block else []
        if encounters.column is not None:
            values += [
                v for v in block.tolist() if encounters.low < v <= encounters.high
            ]
        return [encounters.places(value) for value in values]

    def _drive(self, number: int, cars: Sequence[int], places: FloatArray) -> None:
        """Have cars meet encounters of a test at their worst phases, and keep what they met and
        what fails.
        """
        encounters = self._ranges[number]
        of_cars = [self._settings(car, places) for car in cars]
        rows = np.concatenate(of_cars)
        sizes = [len(of_car) for of_car in of_cars]
        # Values above a known failure of a car need not be met at other phases.
        known = [self.failures[car] for car in cars]
        most = [np.inf if failure is None else failure.value for failure in known]
        is_open = encounters.values_in(rows) <= np.repeat(most, sizes)
        robustness = encounters.robustness(rows, self._stage)
        rows, robustness = encounters.at_worst_phases(
            rows, robustness, is_open, self._stage
        )
        ends = np.cumsum(sizes)[:-1]
        for car, own, left in zip(
            cars, np.split(rows, ends), np.split(robustness, ends), strict=True
        ):
            self._note(car, encounters, own, left)
            self._met[car][number].append((own, left))

    def _met_within(self, car: int, number: int, box: Box) -> Falsification:
        """What a car has met of a test within a box, the worst first."""
        met = self._met[car][number]
        settings = np.concatenate(
            [np.zeros((0, len(box.lower))), *(own for own, _ in met)]
        )
        robustness = np.concatenate([np.zeros(0), *(left for _, left in met)])
        is_inside = box.holds(settings) & np.isfinite(robustness)
        order = np.flatnonzero(is_inside)[
            np.argsort(robustness[is_inside], kind="stable")
        ]
        worst = order[:PARENTS]
        return Falsification(
            settings[worst], np.zeros(len(worst), int), robustness[worst], 0
        )

    def _settings(self, car: int, places: FloatArray) -> FloatArray:
        """The settings in which the vehicles of a car meet encounters, some of them in each."""
        cars = self._cars[car]
        vehicles = np.concatenate([cars.at(place) for place in places])
        return np.hstack([vehicles, np.repeat(places, cars.together, axis=0)])

    def _note(
        self,
        car: int,
        encounters: EncounterRange,
        settings: FloatArray,
        robustness: FloatArray,
    ) -> bool:
        """Keep the failure of a car at the least value, of several the worst; whether it fails."""
        failing = np.flatnonzero(robustness < 0)
        if not len(failing):
            return False
        values = encounters.values_in(settings[failing])
        first = np.lexsort((robustness[failing], values))[0]
        row = failing[first]
        found = float(values[first]), float(robustness[row])
        known = self.failures[car]
        if known is None or found < (known.value, known.robustness):
            self.failures[car] = LimitingFailure(
                found[0], encounters, settings[row], found[1]
            )
        return True

    def falsify(self, budget: int) -> None:
        """Search encounters of each car up to its value, with a budget for each, until nothing is
        found.

        A test without a failure up to some value has none up to a lower one, so only those that
        fail are searched again. What is found is a value of the grid, at which all tests were
        driven.
        """
        cars = range(len(self._cars))
        waiting = [
            [car for car in cars if self.up_to(car) is not None] for _ in self._ranges
        ]
        attempt = 0
        while any(waiting):
            attempt += 1
            waiting = [
                self._falsify_test(number, of_test, budget, attempt)
                for number, of_test in enumerate(waiting)
            ]

    def _falsify_test(
        self, number: int, waiting: Sequence[int], budget: int, attempt: int
    ) -> list[int]:
        """Falsify that cars are safe in a test up to their values; those that are not."""
        encounters = self._ranges[number]
        boxes = dict[int, Box]()
        for car in waiting:
            up_to = self.up_to(car)
            own = self._cars[car]
            box = None if up_to is None else encounters.box(own.lower, own.upper, up_to)
            if box is not None:
                boxes[car] = box
        if not boxes:
            return []

        # All cars side by side, each from what it met on the grid.
        met = [self._met_within(car, number, box) for car, box in boxes.items()]
        stream = encounters.model.fit, number, attempt
        rngs = [
            Stream.PERMIT.generator(self._cars[car].number, *stream) for car in boxes
        ]
        share = max(budget // len(self._ranges), LEAST_BUDGET)
        judge = partial(encounters.robustness, stage=self._stage)
        results = falsify_all(
            *([*boxes.values()], [judge], [()] * len(boxes), share, rngs, GENERATION),
            begun=met,
        )
        failing = list[int]()
        for car, found in zip(boxes, results, strict=True):
            self.attacked += found.simulated
            settings = encounters.model.characteristics.with_printed_encounters(
                found.settings
            )
            failing += (
                [car] if self._note(car, encounters, settings, found.robustness) else []
            )
        return failing
