"""Euro NCAP's rear ends: a car ahead that stands, is slower or brakes, CCRs, CCRm and CCRb, and a motorcyclist, CMRs and CMRb."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta
from msgspec.structs import force_setattr

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios.ahead import Ahead, BehindSomebody
from safevar_sumo.scenarios.base import PreCrash
from safevar_sumo.scenarios.euro_ncap import AHEAD, JUNCTION, KMH, Heading, Range

CAR, MOTORCYCLIST = (50.0, 0.0, 25.0, 75.0, 100.0, -25.0, 125.0), (50.0, 10.0, 25.0, 75.0, 90.0)
"""Impact locations [%]."""
NETWORK = "car_to_car"
CRAWL = 2.0
"""Speed down to which the braking target brakes [km/h]."""
STEADY_UP_TO = 80.0
"""Speed up to which the slower target goes 20 km/h; above that 10 km/h faster for each 10 km/h."""


class _Test(NamedTuple):
    """A row of the protocol's table: who is ahead, the range of the tests, time headway at the start [s]."""

    target: str
    range: Range
    headway: float
    pre_crash: PreCrash


TESTS = {
    "CCRs": _Test("car", Range(10, 80, CAR), 5.0, PreCrash.LEAD_STOPPED),
    "CCRm": _Test("car", Range(30, 130, CAR), 5.0, PreCrash.LEAD_SLOWER),
    "CCRb": _Test("car", Range(30, 130, CAR), 1.0, PreCrash.LEAD_DECELERATING),
    "CMRs": _Test("motorcyclist", Range(10, 80, MOTORCYCLIST), 5.0, PreCrash.LEAD_STOPPED),
    "CMRb": _Test("motorcyclist", Range(30, 130, MOTORCYCLIST), 1.0, PreCrash.LEAD_DECELERATING),
}


class CarToCar(BehindSomebody, frozen=True, kw_only=True):
    """A car or a motorcyclist ahead in the lane stands, drives more slowly, or brakes.

    Parameters
    ----------
    test
        CCRs, CCRm or CCRb, CMRs or CMRb: gives the target, its speed and the headway where they are not given here.
    speed, target_speed
        The vehicle's and the target's at the start [km/h].
    impact_location
        Where on the vehicle's front the middle of the target's rear would hit it, from its left corner [% of the width].
    headway
        Gap at the start over the vehicle's speed [s].
    brakes_at, target_deceleration
        When the target of CCRb and CMRb begins to brake, down to 2 km/h [s, m/s^2].
    heading
        Turn of a target that stands, around the middle of its rear, counterclockwise seen from above [degrees].
    time_after
        Time from the impact if nobody brakes to the end of the run [s].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].
    network
        By default `car_to_car`, and `junction` where the target stands askew.

    Notes
    -----
    The conditions of Euro NCAP's calculator (euroncap-rating-2026 5.4.9) for robustness layers: "-2 m/s^2" is an acceleration, so a
    `target_deceleration` of 6; "+0.5s time headway" a `headway` of 1.5 s; a rotation around the impact point a `heading`.
    """

    test: Literal["CCRs", "CCRm", "CCRb", "CMRs", "CMRb"] = "CCRs"
    speed: Annotated[float, Meta(gt=0, le=250)] = 50.0
    target_speed: Annotated[float, Meta(ge=0, le=250)] | None = None
    headway: Annotated[float, Meta(gt=0, le=60)] | None = None
    brakes_at: Annotated[float, Meta(ge=0, le=60)] = 3.0
    target_deceleration: Annotated[float, Meta(gt=0, le=12)] = 4.0
    heading: Heading = 0.0
    time_after: Annotated[float, Meta(gt=0, le=60)] = 5.0
    network: str = ""

    def __post_init__(self) -> None:
        if not self.network:
            force_setattr(self, "network", JUNCTION if self.heading else NETWORK)

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's type."""
        return TESTS[self.test].pre_crash

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self._time_to_impact() + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].range.remarks(self.test, self.speed, self.impact_location, self.grade)

    @property
    def _ahead(self) -> Ahead:
        if self.heading and self._speed_at(0.0):
            raise InputError("scenario.parameters", f"heading = {self.heading:g} with a target that moves", "a heading of one that stands")
        return self._ahead_of(TESTS[self.test].target, self._gap, self._speed_at, AHEAD.turned(self.heading))

    @property
    def _brakes(self) -> bool:
        return TESTS[self.test].pre_crash == PreCrash.LEAD_DECELERATING

    @property
    def _gap(self) -> float:
        return (TESTS[self.test].headway if self.headway is None else self.headway) * self.speed * KMH

    @property
    def _target_speed(self) -> float:
        """At the start [m/s]."""
        slower = 20.0 + max(self.speed - STEADY_UP_TO, 0.0)
        usual = {PreCrash.LEAD_STOPPED: 0.0, PreCrash.LEAD_SLOWER: slower}.get(TESTS[self.test].pre_crash, self.speed)
        return (usual if self.target_speed is None else self.target_speed) * KMH

    def _speed_at(self, time: float) -> float:
        first = self._target_speed
        if not self._brakes:
            return first
        return max(first - self.target_deceleration * max(time - self.brakes_at, 0.0), min(first, CRAWL * KMH))

    def _time_to_impact(self) -> float:
        """If nobody brakes: the gap is closed at a constant speed, or as the target brakes, t^2 b / 2 and then steadily."""
        faster, gap = self.speed * KMH - self._target_speed, self._gap
        if not self._brakes:
            if faster <= 0:
                raise InputError("scenario.parameters", f"speed = {self.speed:g} km/h never reaches the target", "a slower target")
            return gap / faster
        left = gap - faster * self.brakes_at
        if left <= 0:
            return gap / faster
        b, slowed = self.target_deceleration, self._target_speed - self._speed_at(1e9)
        way = (faster + slowed / 2) * slowed / b
        if left > way:
            return self.brakes_at + slowed / b + (left - way) / (faster + slowed)
        return self.brakes_at + (math.sqrt(faster * faster + 2 * b * left) - faster) / b
