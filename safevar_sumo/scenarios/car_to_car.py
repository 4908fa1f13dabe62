"""Euro NCAP's rear-end tests: a car ahead stands (CCRs), is slower (CCRm), brakes (CCRb); a motorcyclist stands (CMRs),
brakes (CMRb).
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta
from msgspec.structs import force_setattr

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios.ahead import TargetAhead, TargetAheadTest
from safevar_sumo.scenarios.base import PreCrash
from safevar_sumo.scenarios.euro_ncap import JUNCTION, KMH, SAME_DIRECTION, Heading, ProtocolRange

CAR_LOCATIONS, MOTORCYCLIST_LOCATIONS = (50.0, 0.0, 25.0, 75.0, 100.0, -25.0, 125.0), (50.0, 10.0, 25.0, 75.0, 90.0)
"""Impact locations [% of the width]."""
NETWORK = "car_to_car"
FINAL_SPEED = 2.0
"""Speed at which the braking target stops braking [km/h]."""
STEADY_SPEED_LIMIT = 80.0
"""Speed of the vehicle up to which the slower target drives at 20 km/h [km/h]; above it, the target is 60 km/h slower.
"""


class _TestRow(NamedTuple):
    """A row of the protocol's table: target, tested speeds and impact locations, time headway at the start [s],
    pre-crash type.
    """

    target: str
    protocol_range: ProtocolRange
    headway: float
    pre_crash: PreCrash


TESTS = {  # target, range (slowest, fastest, impact locations), headway, pre-crash type
    "CCRs": _TestRow("car", ProtocolRange(10, 80, CAR_LOCATIONS), 5.0, PreCrash.LEAD_STOPPED),
    "CCRm": _TestRow("car", ProtocolRange(30, 130, CAR_LOCATIONS), 5.0, PreCrash.LEAD_SLOWER),
    "CCRb": _TestRow("car", ProtocolRange(30, 130, CAR_LOCATIONS), 1.0, PreCrash.LEAD_DECELERATING),
    "CMRs": _TestRow("motorcyclist", ProtocolRange(10, 80, MOTORCYCLIST_LOCATIONS), 5.0, PreCrash.LEAD_STOPPED),
    "CMRb": _TestRow("motorcyclist", ProtocolRange(30, 130, MOTORCYCLIST_LOCATIONS), 1.0, PreCrash.LEAD_DECELERATING),
}


class CarToCar(TargetAheadTest, frozen=True, kw_only=True):
    """A car or a motorcyclist ahead in the lane stands, drives more slowly, or brakes.

    Parameters
    ----------
    test
        CCRs, CCRm, CCRb, CMRs or CMRb: determines the target, and its speed and headway unless they are set here.
    speed, target_speed
        Speeds of the vehicle under test and of the target at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the middle of the target's rear, from the left corner [% of the
        width].
    headway
        Gap at the start divided by the vehicle's speed [s].
    brakes_at, target_deceleration
        Time at which the target of CCRb and CMRb begins to brake, and its deceleration, down to 2 km/h [s, m/s^2].
    heading
        Rotation of a standing target around the middle of its rear, counterclockwise seen from above [degrees].
    time_after
        Time from the impact, if nobody brakes, to the end of the run [s].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].
    network
        By default `car_to_car`, or `junction` for a rotated target.

    Notes
    -----
    Robustness layers in the words of Euro NCAP's calculator (euroncap-rating-2026 5.4.9): "-2 m/s^2" is an
    acceleration, hence a `target_deceleration` of 6; "+0.5s time headway" is a `headway` of 1.5 s; a rotation around
    the impact point is a `heading`.
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
        """NHTSA's pre-crash type."""
        return TESTS[self.test].pre_crash

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self._time_to_impact() + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].protocol_range.remarks(self.test, self.speed, self.impact_location, self.grade)

    @property
    def _target_ahead(self) -> TargetAhead:
        if self.heading and self._target_speed_at(0.0):
            raise InputError(
                "scenario.parameters",
                f"heading = {self.heading:g} with a moving target",
                "a heading for a standing target",
            )
        direction = SAME_DIRECTION.turned(self.heading)
        return self._target_at_impact_location(TESTS[self.test].target, self._gap, self._target_speed_at, direction)

    @property
    def _target_brakes(self) -> bool:
        return TESTS[self.test].pre_crash == PreCrash.LEAD_DECELERATING

    @property
    def _gap(self) -> float:
        return (TESTS[self.test].headway if self.headway is None else self.headway) * self.speed * KMH

    @property
    def _target_speed(self) -> float:
        """Speed of the target at the start [m/s]."""
        slower_speed = 20.0 + max(self.speed - STEADY_SPEED_LIMIT, 0.0)
        default = {PreCrash.LEAD_STOPPED: 0.0, PreCrash.LEAD_SLOWER: slower_speed}.get(
            TESTS[self.test].pre_crash, self.speed
        )
        return (default if self.target_speed is None else self.target_speed) * KMH

    def _target_speed_at(self, time: float) -> float:
        initial_speed = self._target_speed
        if not self._target_brakes:
            return initial_speed
        return max(
            initial_speed - self.target_deceleration * max(time - self.brakes_at, 0.0),
            min(initial_speed, FINAL_SPEED * KMH),
        )

    def _time_to_impact(self) -> float:
        """Time to the impact if the vehicle does not brake [s].

        The gap closes at a constant speed. A target that brakes at b m/s^2 makes this speed rise by b per second until
        it stops braking.
        """
        closing_speed, gap = self.speed * KMH - self._target_speed, self._gap
        if not self._target_brakes:
            if closing_speed <= 0:
                raise InputError(
                    "scenario.parameters", f"speed = {self.speed:g} km/h never reaches the target", "a slower target"
                )
            return gap / closing_speed
        remaining_gap = gap - closing_speed * self.brakes_at
        if remaining_gap <= 0:
            return gap / closing_speed
        b, speed_lost = self.target_deceleration, self._target_speed - self._target_speed_at(math.inf)
        gap_closed = (closing_speed + speed_lost / 2) * speed_lost / b
        if remaining_gap > gap_closed:
            return self.brakes_at + speed_lost / b + (remaining_gap - gap_closed) / (closing_speed + speed_lost)
        return self.brakes_at + (math.sqrt(closing_speed * closing_speed + 2 * b * remaining_gap) - closing_speed) / b
