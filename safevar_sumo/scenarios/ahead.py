"""Euro NCAP's tests with a target ahead in the vehicle's lane.

A pedestrian (CPLA) or a cyclist (CBLA) moves along the lane. A car stands (CCRs), is slower (CCRm)
or brakes (CCRb); a motorcyclist stands (CMRs) or brakes (CMRb).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from msgspec.structs import replace

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Quantity
from safevar_sumo.scenarios.base import PreCrash, Scenario
from safevar_sumo.scenarios.euro_ncap import (
    SAME_DIRECTION,
    Direction,
    Heading,
    ImpactLocation,
    Metres,
    ProtocolTest,
    Seconds,
    TargetProfile,
    lateral_offset,
)
from safevar_sumo.scenarios.tracks import (
    BODIES,
    KMH,
    LaneTest,
    Speed,
    Track,
    first_in_strip,
    travelled,
)
from safevar_sumo.study import searched

STEADY_SPEED_LIMIT = 80.0
"""Speed of the vehicle up to which a slower target drives at 20 km/h by default [km/h]. If the
vehicle is faster, the target is 60 km/h slower than the vehicle.
"""
FASTEST_TARGET = 130.0
"""Highest speed of a target ahead [km/h]: the highest speed of the vehicle in Euro NCAP's tests and
in UN R157.
"""


BESIDE = (-50.0, -40.0)
"""Lateral places of a benign target that moves along beside the vehicle's path [% of the vehicle's
width, from its left corner].
"""
LANE_WIDTH = 3.5
"""Distance between the middles of two lanes [m]."""
HEADWAYS = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0)
"""Distances of a car in the next lane at the start, as time headways [s]. Scenarios with other
benign scenes use every fourth headway.
"""
VEHICLE_SPEED = searched(10.0, 130.0, "km/h", "speed of the vehicle at the start")
"""Marks the vehicle's speed as a parameter that a study may search."""


class TargetAhead(ProtocolTest, frozen=True, kw_only=True):
    """Base of a scenario with a target ahead in the vehicle's lane; for its parameters see
    `ProtocolTest`.

    The middle of the target's rear is at the impact location. A standing target may be rotated
    around that point.
    """

    speed: Annotated[Speed, VEHICLE_SPEED] = 40.0
    impact_location: Annotated[
        ImpactLocation,
        searched(
            0.0,
            100.0,
            "%",
            "impact location, share of the vehicle's front from its left corner",
        ),
    ] = 50.0

    @property
    def gap(self) -> Quantity:
        """Gap to the target at the start [m]."""
        raise NotImplementedError

    def target_speed_at(self, time: Quantity) -> Quantity:
        """The target's speed [m/s] at a time [s]."""
        raise NotImplementedError

    @property
    def direction(self) -> Direction:
        """The direction in which the target faces."""
        return SAME_DIRECTION

    def tracks(self, times: FloatArray) -> list[Track]:
        """The track of the target. Its first point in the vehicle's path is at the gap at the
        start; then the target moves ahead.
        """
        target = self.parameter("target")
        direction = self.direction
        body = BODIES[target]
        speeds = self.target_speed_at(times)
        # The distance of the middle of the target's rear to the right of the lane's middle.
        offset = lateral_offset(self.impact_location, self.vut_width)
        y = direction.left * body.length / 2 - offset
        target_at_gap = Track("target", target, *body, self.gap, y, *direction, speeds)
        first_point = first_in_strip(target_at_gap._replace(x=0.0), self.vut_width / 2)
        return [
            target_at_gap._replace(x=self.gap - first_point + travelled(speeds, times))
        ]


class Along(TargetAhead, frozen=True, kw_only=True):
    """A pedestrian or cyclist moves ahead in the vehicle's lane in its direction, and does not
    react to it.

    For other parameters see `LaneTest`.

    Parameters
    ----------
    test
        Row of the protocol, CPLA or CBLA: the source of parameters that are not set here.
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the target, from the left corner [% of the
        width].
    target, target_speed, acceleration_distance
        `adult`, `child` or `cyclist`; the target's speed [km/h], and the distance within which the
        target reaches that speed [m].
    time_to_impact, time_after
        Time from the start to the impact if nobody brakes, and time from the impact to the end of
        the run [s].

    Notes
    -----
    By default the cyclist rides at 15 km/h from the start; the protocol has 20 km/h in its rows
    that are judged by the warning.
    """

    test: Literal["CPLA", "CBLA"] = "CPLA"
    target: Literal["adult", "child", "cyclist"] | None = None
    target_speed: (
        Annotated[
            float, Meta(ge=0, le=60), searched(1.0, 40.0, "km/h", "speed of the target")
        ]
        | None
    ) = None
    acceleration_distance: Metres | None = None
    time_to_impact: Seconds = 6.0

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """The target moves along beside the vehicle's path, or a car stands in the next lane."""
        for place in BESIDE:
            name = f"{self.test}, {self.speed:g} km/h, beside at {place:g} %"
            yield name, replace(self, impact_location=place)
        yield from next_lane(self, HEADWAYS[::4])

    def obstacle(self) -> str:
        """The target in words, with "ahead"."""
        return f"{super().obstacle()} ahead"

    @property
    def duration(self) -> Quantity:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    @property
    def gap(self) -> Quantity:
        """The gap to the target at the start [m]: the gap that closes in `time_to_impact`."""
        return self.test_speed * self.time_to_impact - self._profile.travelled(
            self.time_to_impact
        )

    def target_speed_at(self, time: Quantity) -> Quantity:
        """The target's speed [m/s] at a time [s]."""
        return self._profile.speed_at(time)

    @property
    def _profile(self) -> TargetProfile:
        # With numpy's float, a division by the speed 0 of a standing target gives infinity, no
        # error.
        speed = np.float64(self.parameter("target_speed")) * KMH
        return TargetProfile(0.0, speed, self.parameter("acceleration_distance"))


class CarToCar(TargetAhead, frozen=True, kw_only=True):
    """A car or a motorcyclist ahead in the lane stands, drives more slowly, or brakes.

    For other parameters see `LaneTest`.

    Parameters
    ----------
    test
        CCRs, CCRm, CCRb, CMRs or CMRb: determines the target, and its speed and headway unless they
        are set here.
    speed, target_speed
        Speeds of the vehicle under test and of the target at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the middle of the target's rear, from the left
        corner [% of the width].
    headway
        Gap at the start divided by the vehicle's speed [s].
    brakes_at, target_deceleration, final_speed
        Time at which the target of CCRb and CMRb begins to brake, its deceleration, and the speed
        at which it stops braking [s, m/s^2, km/h].
    heading
        Rotation of a standing target around the middle of its rear, counterclockwise seen from
        above [degrees].
    time_after
        Time from the impact, if nobody brakes, to the end of the run [s].

    Notes
    -----
    Robustness layers in the words of Euro NCAP's calculator (version 5.4.9): "-2
    m/s^2" is an acceleration, hence a `target_deceleration` of 6; "+0.5s time headway" is a
    `headway` of 1.5 s; a rotation around the impact point is a `heading`.
    """

    test: Literal["CCRs", "CCRm", "CCRb", "CMRs", "CMRb"] = "CCRs"
    speed: Annotated[Speed, VEHICLE_SPEED] = 50.0
    target_speed: (
        Annotated[
            float,
            Meta(ge=0, le=250),
            searched(0.0, 130.0, "km/h", "speed of the target at the start"),
        ]
        | None
    ) = None
    headway: (
        Annotated[
            Seconds,
            searched(
                0.5,
                10.0,
                "s",
                "headway, gap at the start divided by the vehicle's speed",
            ),
        ]
        | None
    ) = None
    brakes_at: Annotated[float, Meta(ge=0, le=60)] = 3.0
    target_deceleration: Annotated[
        float,
        Meta(gt=0, le=12),
        searched(0.5, 10.0, "m/s^2", "deceleration of the target"),
    ] = 4.0
    final_speed: Annotated[float, Meta(ge=0, le=150)] = 2.0
    heading: Heading = 0.0
    time_after: Seconds = 5.0
    border = "headway"

    @property
    def duration(self) -> Quantity:
        """Length of a run [s]. The run ends after the impact without braking, and after the
        target's braking.
        """
        end = self._time_to_impact()
        if self._target_brakes:
            speed_drop = self._target_speed - self.target_speed_at(math.inf)
            end = np.maximum(
                end, self.brakes_at + speed_drop / self.target_deceleration
            )
        return end + self.time_after

    @property
    def gap(self) -> Quantity:
        """Gap to the target at the start [m]."""
        return self.parameter("headway") * self.speed * KMH

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """A car stands in the next lane."""
        return next_lane(self)

    def check(self) -> None:
        """Refuse a target that is faster than the target of any test."""
        if self._target_speed > FASTEST_TARGET * KMH:
            raise InputError(
                "",
                f"target_speed = {self._target_speed / KMH:g} km/h",
                f"up to {FASTEST_TARGET:g} km/h",
            )

    @property
    def direction(self) -> Direction:
        """Direction of the target."""
        if self.heading and self._target_speed:
            raise InputError(
                "",
                f"heading = {self.heading:g} with a moving target",
                "a heading for a standing target",
            )
        return SAME_DIRECTION.turned(self.heading)

    @property
    def _target_brakes(self) -> bool:
        return self.pre_crash == PreCrash.LEAD_DECELERATING

    @property
    def _target_speed(self) -> Quantity:
        """Speed of the target at the start [m/s]. Without a stated speed, the test's kind
        decides.
        """
        if self.target_speed is not None:
            return self.target_speed * KMH
        slower_speed = 20.0 + np.maximum(self.speed - STEADY_SPEED_LIMIT, 0.0)
        defaults = {PreCrash.LEAD_STOPPED: 0.0, PreCrash.LEAD_SLOWER: slower_speed}
        return defaults.get(self.pre_crash, self.speed) * KMH

    def target_speed_at(self, time: Quantity) -> Quantity:
        """The target's speed [m/s] at a time [s]."""
        first_speed = self._target_speed
        if not self._target_brakes:
            return first_speed
        last_speed = np.minimum(first_speed, self.final_speed * KMH)
        braking_time = np.maximum(time - self.brakes_at, 0.0)
        return np.maximum(
            first_speed - self.target_deceleration * braking_time, last_speed
        )

    # `np.where` also computes the cases that it does not choose, and these may divide by 0.
    @np.errstate(all="ignore")
    def _time_to_impact(self) -> Quantity:
        """The time from the start to the impact if the vehicle does not brake [s].

        The gap closes at a constant speed, until the target brakes at b m/s^2. Then the closing
        speed rises by b per second until the target stops braking.
        """
        closing_speed = self.test_speed - self._target_speed
        gap = self.gap
        if not self._target_brakes:
            if np.any(closing_speed <= 0):
                raise InputError(
                    "",
                    f"speed = {np.min(self.speed):g} km/h never reaches the target",
                    "a slower target",
                )
            return gap / closing_speed

        # The gap may close before the target brakes, while the target brakes, or afterwards.
        gap_at_braking = gap - closing_speed * self.brakes_at
        b = self.target_deceleration
        speed_lost = self._target_speed - self.target_speed_at(math.inf)
        closed_by_braking = (closing_speed + speed_lost / 2) * speed_lost / b
        gap_after_braking = gap_at_braking - closed_by_braking
        time_after_braking = (
            self.brakes_at
            + speed_lost / b
            + gap_after_braking / (closing_speed + speed_lost)
        )
        root = np.sqrt(closing_speed * closing_speed + 2 * b * gap_at_braking)
        time_in_braking = self.brakes_at + (root - closing_speed) / b
        braking = np.where(
            gap_at_braking > closed_by_braking, time_after_braking, time_in_braking
        )
        return np.where(gap_at_braking <= 0, gap / np.float64(closing_speed), braking)[
            ()
        ]


def next_lane(
    test: LaneTest, headways: Sequence[float] = HEADWAYS
) -> Iterable[tuple[str, Scenario]]:
    """Benign scenes of a test: a car stands in the next lane at these headways [s]. Each scene has
    a description.
    """
    width = test.vut_width
    place = 100 * (LANE_WIDTH / width + 0.5)
    beside = CarToCar(
        speed=test.speed,
        vut_length=test.vut_length,
        vut_width=width,
        impact_location=place,
    )
    for headway in headways:
        yield (
            f"{test.speed:g} km/h, a car in the next lane {headway:g} s ahead",
            replace(beside, headway=headway),
        )
