"""What `permit` found: plain values, from which the answer is told without any simulation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.speed_search import LimitingFailure
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

MOST_LIMITING = 3
"""Largest number of failures of a car that are simulated first with each of its repairs."""
DRIVE = "drive"
LIMITED = "up to"
STOP = "stop"
"""Verdicts on a car. DRIVE: as fast as the user needs or, without a stated need, as fast as the new
car or the fastest test. LIMITED: up to a speed. STOP: not at all.
"""


class Example(NamedTuple):
    """How a car fails, as it is told. All values but the words are None if the car, as it is told,
    is safe in all of its fresh runs.

    Attributes
    ----------
    because
        The failure in words.
    test, encounter
        The name of the test and the values of the encounter; None without them.
    phase
        The phase of the encounter; None if the study has no phases.
    outcome
        How the car fails, such as `collides at 3.21 m/s`.
    simulate
        The command that simulates the failure.
    """

    because: str
    test: str | None = None
    encounter: str | None = None
    phase: float | None = None
    outcome: str | None = None
    simulate: str | None = None


class Reached(NamedTuple):
    """How far a car is safe in one parameter set.

    Attributes
    ----------
    number
        The number of the parameter set.
    safe_value
        The greatest value up to which the car is safe; None if it fails already at the least value.
    failure
        The failure that limits the car; None if none was found.
    example
        This failure as it is told; None without a failure, and while others are searched.
    """

    number: int
    safe_value: float | None
    failure: LimitingFailure | None
    example: Example | None = None

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
        """The greatest value up to which the car is safe in all sets; None without one."""
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
        """`safe_value` as a number that can be compared."""
        return self.least.order


class Repaired(NamedTuple):
    """The repair that raises a car's speed most: one characteristic has its original value again.

    Attributes
    ----------
    name
        The name of the characteristic.
    safe_value
        The greatest value up to which the repaired car is safe.
    """

    name: str
    safe_value: float | None


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


class FoundCar(NamedTuple):
    """What was found about a car of the list.

    Attributes
    ----------
    name
        The name of the car.
    permit
        How far the car is safe.
    repaired
        The best repair; None if no single repair raises the speed, or none was searched.
    worst_end
        The assumed value that matters most; None if none lowers the speed, or none was searched.
    """

    name: str
    permit: Permit
    repaired: Repaired | None = None
    worst_end: WorstEnd | None = None


@dataclass(frozen=True, kw_only=True)
class Found:
    """How far the cars of a list are safe, and the failures that show why they are no farther.

    Attributes
    ----------
    study, scope
        The study; the tests and encounters that the answer covers, in words.
    digest
        The beginning of the digest that identifies the study, its models and versions.
    span
        The parameter over which cars are driven, usually the speed, and its range.
    need
        The speed that every car must reach; None without one.
    step
        The step of the grid of speeds.
    vehicle
        The characteristics of the vehicle.
    unsafe
        The criterion of an unsafe vehicle.
    sets
        Number of parameter sets.
    values, is_listed
        The values at which all cars were driven, and whether tests list all of them.
    attacked
        Number of simulations that searched for counterexamples.
    fleet
        The list of cars.
    new_car
        The greatest value up to which the new car is safe.
    cars
        The cars, in the order of the list.
    phases
        The remark on the moments at which encounters began; "" if none is needed.
    is_quick
        Whether cars were driven only at the grid's speeds, without a search for counterexamples.
    is_rough
        Whether the answer is rough for any reason.
    is_box
        Whether the only "car" stands for all cars within the limits that the user states.
    has_worst_ends
        Whether assumed values were tried at the ends of their domains.
    """

    study: Study
    scope: str
    digest: str
    span: Span
    need: float | None
    step: float
    vehicle: CharacteristicSet
    unsafe: Unsafe
    sets: int
    values: FloatArray
    is_listed: bool
    attacked: int
    fleet: Fleet
    new_car: float
    cars: Sequence[FoundCar]
    phases: str
    is_quick: bool
    is_rough: bool
    is_box: bool
    has_worst_ends: bool

    def verdict_of(self, car: FoundCar) -> str:
        """The verdict on a car. Only a search for counterexamples lets a car drive without a
        limit.
        """
        safe_value = car.permit.safe_value
        if safe_value is None:
            return STOP
        need = min(self.span.high, self.new_car) if self.need is None else self.need
        return DRIVE if safe_value >= need and not self.is_quick else LIMITED

    @property
    def counts(self) -> Counter[str]:
        """The number of cars with each verdict."""
        return Counter(self.verdict_of(car) for car in self.cars)

    @property
    def too_slow(self) -> int:
        """The number of cars that do not reach the speed that the user needs."""
        if self.need is None:
            return 0
        return sum(car.permit.order < self.need for car in self.cars)

    @property
    def is_test(self) -> bool:
        """Whether the study is a test of a regulation: a car passes by the regulation's rules, but
        need not be safe otherwise.
        """
        allows_impacts = any(test.allowed_impact_speed for test in self.study.tests)
        return allows_impacts or bool(self.study.unsafe.source)
