"""Euro NCAP's rear ends: CCRs, CCRm, CCRb."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios.base import Actors, PreCrash, Roads
from safevar_sumo.scenarios.euro_ncap import KMH, Ahead, BehindSomebody, Body, Range, lateral_of

CAR = Body(4.023, 1.712)
"""Euro NCAP's global vehicle target [m]."""
LOCATIONS = (0.0, 25.0, 50.0, 75.0, 100.0)
PROTOCOL = {"CCRs": Range(10, 50, LOCATIONS), "CCRm": Range(30, 130, LOCATIONS), "CCRb": Range(30, 80, LOCATIONS)}
PRE_CRASH = {"CCRs": PreCrash.LEAD_STOPPED, "CCRm": PreCrash.LEAD_SLOWER, "CCRb": PreCrash.LEAD_DECELERATING}
CRAWL = 2.0
"""Speed down to which the braking target brakes [km/h]."""
HEADWAY = {"CCRs": 5.0, "CCRm": 5.0, "CCRb": 1.0}
"""Time headway at the start [s]."""
STEADY_UP_TO = 80.0
"""Speed up to which the slower target goes 20 km/h; above that 10 km/h faster for each 10 km/h."""


class CarToCar(BehindSomebody, frozen=True, kw_only=True):
    """A car ahead in the lane stands, drives more slowly, or brakes.

    Parameters
    ----------
    test
        CCRs, CCRm or CCRb: gives the target's speed and the headway where they are not given here.
    speed, target_speed
        The vehicle's and the target's at the start [km/h].
    impact_location
        Where on the vehicle's front the target's middle would hit it, from its left corner [% of the width].
    headway
        Gap at the start over the vehicle's speed [s].
    brakes_at, target_deceleration
        When the target of CCRb begins to brake, down to 2 km/h [s, m/s^2].
    time_after
        Time from the impact if nobody brakes to the end of the run [s].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].
    """

    test: Literal["CCRs", "CCRm", "CCRb"] = "CCRs"
    speed: Annotated[float, Meta(gt=0, le=250)] = 50.0
    target_speed: Annotated[float, Meta(ge=0, le=250)] | None = None
    impact_location: Annotated[float, Meta(ge=0, le=100)] = 50.0
    headway: Annotated[float, Meta(gt=0, le=60)] | None = None
    brakes_at: Annotated[float, Meta(ge=0, le=60)] = 3.0
    target_deceleration: Annotated[float, Meta(gt=0, le=12)] = 4.0
    time_after: Annotated[float, Meta(gt=0, le=60)] = 5.0
    network: str = "car_to_car"

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's type."""
        return PRE_CRASH[self.test]

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self._time_to_impact() + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return PROTOCOL[self.test].remarks(self.test, self.speed, self.impact_location, self.grade)

    def actors(self, roads: Roads) -> Actors:
        return self._ahead.actors("car", Body(self.vut_length, self.vut_width), self.speed * KMH)

    @property
    def _ahead(self) -> Ahead:
        return Ahead(CAR, self._gap, lateral_of(self.impact_location, self.vut_width), self._speed_at)

    @property
    def _gap(self) -> float:
        return (HEADWAY[self.test] if self.headway is None else self.headway) * self.speed * KMH

    @property
    def _target_speed(self) -> float:
        """At the start [m/s]."""
        slower = 20.0 + max(self.speed - STEADY_UP_TO, 0.0)
        usual = {"CCRs": 0.0, "CCRm": slower, "CCRb": self.speed}[self.test]
        return (usual if self.target_speed is None else self.target_speed) * KMH

    def _speed_at(self, time: float) -> float:
        first = self._target_speed
        if self.test != "CCRb":
            return first
        return max(first - self.target_deceleration * max(time - self.brakes_at, 0.0), min(first, CRAWL * KMH))

    def _time_to_impact(self) -> float:
        """If nobody brakes: the gap is closed at a constant speed, or as the target brakes, t^2 b / 2 and then steadily."""
        faster, gap = self.speed * KMH - self._target_speed, self._gap
        if self.test != "CCRb":
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
