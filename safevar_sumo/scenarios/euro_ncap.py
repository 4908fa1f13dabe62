"""Parts that the scenarios of Euro NCAP's frontal crash avoidance tests share (protocol CA-FC,
v1.2, July 2026): the protocol's table, directions of targets, and speeds of targets over time.

As in the protocol, speeds are in km/h, and impact locations in per cent of the vehicle's width.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.records import Quantity
from safevar_sumo.scenarios.base import PreCrash
from safevar_sumo.scenarios.tracks import BodySize, LaneTest
from safevar_sumo.shipped import shipped_table
from safevar_sumo.study import Table

Metres = Annotated[float, Meta(ge=0, le=100)]
Seconds = Annotated[float, Meta(gt=0, le=60)]
ImpactLocation = Annotated[float, Meta(ge=-50, le=150)]
"""A point on or beside the vehicle's front [% of the vehicle's width]."""
Heading = Annotated[float, Meta(ge=-30, le=30)]
"""Rotation of a target's path, counterclockwise seen from above [degrees]."""


class Direction(NamedTuple):
    """The direction of a target: a unit vector with its parts along the vehicle's lane and to the
    left.
    """

    along: float
    left: float

    def turned(self, heading: float) -> Direction:
        """Turn the direction counterclockwise by `heading` [degrees].

        Sine and cosine are rounded, because their last bits differ between machines.
        """
        angle = math.radians(heading)
        cosine = round(math.cos(angle), 12)
        sine = round(math.sin(angle), 12)
        return Direction(
            self.along * cosine - self.left * sine,
            self.left * cosine + self.along * sine,
        )

    def extent(self, body: BodySize) -> float:
        """The extent along the lane of a body that faces in this direction [m]."""
        return body.length * abs(self.along) + body.width * abs(self.left)


SAME_DIRECTION = Direction(1.0, 0.0)
FROM_RIGHT = Direction(0.0, 1.0)
FROM_LEFT = Direction(0.0, -1.0)


class TestRow(Table, frozen=True):
    """A row of the protocol's table.

    Attributes
    ----------
    words
        A description of the test, for readers who do not know its name.
    target
        The kind of the target.
    pre_crash
        The pre-crash type of the encounter.
    slowest, fastest
        Range of the vehicle's tested speeds [km/h].
    locations
        Tested impact locations [% of the vehicle's width].
    target_speed
        Speed of the target [km/h].
    acceleration_distance
        Distance within which the target reaches its speed [m].
    side
        Side from which a crossing target comes.
    lateral_start
        Distance at which a crossing target starts [m]. None: the target starts at its full speed.
    hidden
        Whether parked cars hide a crossing target.
    headway
        Time headway at the start to a car or motorcyclist ahead [s].
    """

    words: str
    target: str
    pre_crash: PreCrash
    slowest: float
    fastest: float
    locations: tuple[float, ...]
    target_speed: float = 0.0
    acceleration_distance: float = 0.0
    side: str = "near"
    lateral_start: float | None = None
    hidden: bool = False
    headway: float = 5.0


TESTS = msgspec.convert(shipped_table("scenarios/euro_ncap.toml"), dict[str, TestRow])
"""The rows of the protocol's table, by the names of the tests, from euro_ncap.toml beside this
module.
"""


class TargetProfile(NamedTuple):
    """The speed over time of a target, or of N targets if the values are arrays. The target stands
    until `begin` [s], and accelerates evenly to `speed` [m/s] within `run_up` [m].
    """

    begin: Quantity
    speed: Quantity
    run_up: float

    @classmethod
    def with_arrival(
        cls, distance: Quantity, time: Quantity, speed: Quantity, run_up: float
    ) -> TargetProfile:
        """The profile of a target that covers `distance` [m] up to `time` [s].

        After the run-up, distance = speed * (time - begin) - run_up.
        """
        if np.any(distance < run_up):
            raise InputError(
                "",
                f"acceleration_distance = {run_up:g} m is longer than the distance of"
                f" {np.min(distance):g} m",
            )
        shortest_time = (distance + run_up) / speed
        begin = time - shortest_time
        if np.any(begin < 0):
            raise InputError(
                "",
                f"time_to_impact: the target needs {np.max(shortest_time):.2f} s to the impact, and"
                f" has {np.max(time):g} s",
                "a faster target, a shorter distance or a longer time_to_impact",
            )
        return cls(begin, speed, run_up)

    # `np.where` computes both cases: the case of a target without run-up divides by 0.
    @np.errstate(all="ignore")
    def travelled(self, time: Quantity) -> Quantity:
        """The distance covered [m] at a time [s]."""
        elapsed = np.maximum(time - self.begin, 0.0)
        # At even acceleration, the mean speed of the run-up is half of the full speed.
        return np.where(
            elapsed >= 2 * self.run_up / self.speed,
            self.speed * elapsed - self.run_up,
            self.speed * self.speed / (4 * np.float64(self.run_up)) * elapsed * elapsed,
        )[()]

    @np.errstate(all="ignore")
    def speed_at(self, time: Quantity) -> Quantity:
        """The speed [m/s] at a time [s]."""
        elapsed = time - self.begin
        rising = self.speed * self.speed / (2 * np.float64(self.run_up)) * elapsed
        steady = np.where(elapsed >= 2 * self.run_up / self.speed, self.speed, rising)
        return np.where(elapsed < 0, 0.0, steady)[()]


def lateral_offset(location: Quantity, width: float) -> Quantity:
    """The distance of an impact location [% of `width`] from the middle of the front [m]. The
    distance is below 0 on the side from which `location` counts.
    """
    return (location / 100 - 0.5) * width


class ProtocolTest(LaneTest, frozen=True, kw_only=True):
    """Base of the protocol's scenarios, with the parameters that all of them have; for others see
    `LaneTest`.

    Parameters
    ----------
    test
        Row of the protocol, the source of parameters that are not set.
    impact_location
        Point of the vehicle's front that would hit the target [% of the width].
    time_after
        Time from the impact, if nobody brakes, to the end of the run [s].
    """

    test: str
    impact_location: ImpactLocation = 50.0
    time_after: Seconds = 4.0

    @property
    def pre_crash(self) -> PreCrash:
        """The encounter's type in NHTSA's typology of pre-crash scenarios."""
        return TESTS[self.test].pre_crash

    def parameter(self, name: str) -> Any:
        """The value of a parameter: the study's value, or else the protocol's value."""
        value = getattr(self, name, None)
        if value is None:
            return getattr(TESTS[self.test], name)
        return value

    def remarks(self) -> list[str]:
        """Remarks on parameters outside of the protocol's ranges, and on a road that is not
        level.
        """
        row = TESTS[self.test]
        remarks = []
        if not row.slowest <= self.speed <= row.fastest:
            tested = f"{row.slowest:g} to {row.fastest:g} km/h"
            remarks.append(
                f"speed = {self.speed:g} km/h is outside the protocol's {tested}"
            )
        if self.impact_location not in row.locations:
            tested = ", ".join(f"{location:g}" for location in row.locations)
            remarks.append(
                f"impact_location = {self.impact_location:g} % is none of the protocol's {tested} %"
            )
        if self.grade:
            remarks.append(
                f"grade = {self.grade:g} %, and the protocol's road is level"
            )
        return [f"{self.test}: {remark}" for remark in remarks]
