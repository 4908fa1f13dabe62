"""Two scenarios of UN R157 (annex 4, appendix 3): a car cuts in from the next lane, and a leader
cuts out and reveals a standing car.

The car moves sideways as in the regulation's figures: at a constant speed, from the middle of a
lane to the middle of the next lane. Bodies stay parallel to the lanes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Quantity, significant
from safevar_sumo.scenarios.ahead import LANE_WIDTH, VEHICLE_SPEED, next_lane
from safevar_sumo.scenarios.base import PreCrash, Scenario, XmlChanges
from safevar_sumo.scenarios.euro_ncap import Seconds
from safevar_sumo.scenarios.roads import Roads
from safevar_sumo.scenarios.tracks import (
    BODIES,
    DEPARTURE,
    KMH,
    BodySize,
    LaneTest,
    Track,
    travelled,
)
from safevar_sumo.study import searched

OTHER_CAR = BodySize(BODIES["car"].length, 1.9)
"""Size of the other cars [m]. Their width is the width in the regulation."""
BEGINS_AT = 1.0
"""Time at which the lateral movement begins [s]. Before this time, a driver can see in which lane
the car drives.
"""
MotorwaySpeed = Annotated[float, Meta(gt=0, le=130), VEHICLE_SPEED]
"""Speed of the vehicle under test [km/h]. The largest speed is that of the regulation's 01
series.
"""
Gap = Annotated[
    float,
    Meta(gt=0, le=500),
    searched(5.0, 120.0, "m", "gap when the lateral movement begins"),
]
LateralSpeed = Annotated[
    float, Meta(gt=0, le=5), searched(0.5, 3.0, "m/s", "speed of the lateral movement")
]


class LaneChange(LaneTest, frozen=True, kw_only=True):
    """Base of both scenarios: a car changes from or to the next lane. `side` is the side of the
    vehicle on which this lane is. For other parameters see `LaneTest`.
    """

    speed: MotorwaySpeed = 80.0
    gap: Gap = 40.0
    lateral_speed: LateralSpeed = 1.0
    side: Literal["left", "right"] = "left"
    network: str = "two_lanes"

    def actors(self, roads: Roads) -> XmlChanges:
        """Set the vehicle's departure, and its lane: the next lane must be at the needed side."""
        changes = super().actors(roads)
        # The lane to the right has the number 0.
        departure = {**(changes[DEPARTURE] or {}), "departLane": f"{self.sign < 0:d}"}
        return {**changes, DEPARTURE: departure}

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """A car stays in the next lane in each benign scene."""
        return next_lane(self)

    def moved(self, times: FloatArray) -> Quantity:
        """The distance that the car has moved sideways [m]."""
        return np.minimum(
            self.lateral_speed * np.maximum(times - BEGINS_AT, 0.0), LANE_WIDTH
        )

    @property
    def sign(self) -> float:
        """1 if the next lane is to the left, -1 if it is to the right."""
        if self.side == "left":
            return 1.0
        return -1.0


class CutIn(LaneChange, frozen=True, kw_only=True):
    """A car in the next lane moves into the vehicle's lane, and may brake there.

    Parameters
    ----------
    speed, target_speed
        Speeds of the vehicle under test and of the other car at the start [km/h]; by default the
        other car is 20 km/h slower, and not slower than 10 km/h.
    gap
        Distance of the other car's rear ahead of the vehicle's front when it begins to move
        sideways [m].
    lateral_speed
        Speed at which it moves sideways, 3.5 m from lane's middle to lane's middle [m/s].
    side
        The side that it comes from.
    target_deceleration
        Deceleration from the middle of the lane on, down to a stop [m/s^2].
    duration
        Length of a run [s].

    Notes
    -----
    Only contacts of the vehicle's front are collisions: a car that drives its flank or rear corner
    into the vehicle's side is listed.
    """

    target_speed: (
        Annotated[
            float,
            Meta(ge=0, le=130),
            searched(10.0, 130.0, "km/h", "speed of the car that cuts in"),
        ]
        | None
    ) = None
    target_deceleration: Annotated[
        float,
        Meta(ge=0, le=12),
        searched(0.0, 10.0, "m/s^2", "deceleration of the car once it is in the lane"),
    ] = 0.0
    duration: Seconds = 30.0
    pre_crash = PreCrash.CUT_IN
    border = "gap"

    @property
    def first_speed(self) -> Quantity:
        """Speed of the other car at the start [m/s]."""
        if self.target_speed is None:
            return np.maximum(self.speed - 20.0, 10.0) * KMH
        return self.target_speed * KMH

    def check(self) -> None:
        """Refuse a car that is beside the vehicle before any part of the car is in its lane."""
        enters_after = (LANE_WIDTH - OTHER_CAR.width) / 2 / self.lateral_speed
        closed_gap = (self.start_speed - self.first_speed) * enters_after
        if self.gap - closed_gap <= 0:
            raise InputError(
                "",
                f"gap = {self.gap:g} m is closed before the car is in the lane, after"
                f" {enters_after:.2f} s",
                f"a gap above {significant(closed_gap, 4)} m",
            )

    def tracks(self, times: FloatArray) -> list[Track]:
        """The track of the car that cuts in."""
        arrives = BEGINS_AT + LANE_WIDTH / self.lateral_speed
        speed = np.maximum(
            self.first_speed
            - self.target_deceleration * np.maximum(times - arrives, 0.0),
            0.0,
        )
        first_gap = self.gap + (self.start_speed - self.first_speed) * BEGINS_AT
        x = first_gap + OTHER_CAR.length / 2 + travelled(speed, times)
        y = self.sign * (LANE_WIDTH - self.moved(times))
        return [Track("target", "car", *OTHER_CAR, x, y, 1.0, 0.0, speed)]


class CutOut(LaneChange, frozen=True, kw_only=True):
    """A leader at the vehicle's speed leaves the lane and reveals a standing car.

    Parameters
    ----------
    speed
        Speed of both at the start [km/h].
    headway
        Gap to the leader divided by the speed [s].
    gap
        Distance of the standing car's rear ahead of the leader's front when the leader begins to
        move sideways [m].
    lateral_speed
        Speed at which the leader moves sideways, 3.5 m from lane's middle to lane's middle [m/s].
    side
        The side to which the leader leaves.
    time_after
        Time from the impact, if nobody brakes, to the end of the run [s].

    Notes
    -----
    The standing car is hidden until no line from the sensors to its middle is blocked.
    """

    gap: Gap = 80.0
    headway: Annotated[
        Seconds,
        searched(0.5, 4.0, "s", "headway, gap to the leader divided by the speed"),
    ] = 2.0
    time_after: Seconds = 10.0
    pre_crash = PreCrash.LEAD_STOPPED
    border = "headway"

    @property
    def duration(self) -> Quantity:
        """Length of a run [s]."""
        return (
            BEGINS_AT
            + self.headway
            + (OTHER_CAR.length + self.gap) / self.start_speed
            + self.time_after
        )

    def tracks(self, times: FloatArray) -> list[Track]:
        """The tracks of the leader and of the standing car.

        Raises
        ------
        InputError
            If the leader moves sideways too slowly to pass the standing car.
        """
        # When the leader reaches the standing car, he must have left its path.
        speed = self.start_speed
        lateral_way = self.gap / self.start_speed * self.lateral_speed
        if np.any(lateral_way < OTHER_CAR.width):
            raise InputError(
                "",
                f"gap = {np.min(self.gap):g} m: the leader has moved {np.min(lateral_way):.2f} m"
                " sideways when he drives through the standing car",
                f"{OTHER_CAR.width:g} m or more: a larger gap or lateral_speed",
            )

        front = self.headway * speed + OTHER_CAR.length
        x = front - OTHER_CAR.length / 2 + speed * times
        leader = Track(
            "leader",
            "car",
            *OTHER_CAR,
            x,
            self.sign * self.moved(times),
            1.0,
            0.0,
            speed,
        )
        standing = front + speed * BEGINS_AT + self.gap + OTHER_CAR.length / 2
        return [leader, Track.of("target", "car", standing, 0.0, size=OTHER_CAR)]
