"""Somebody ahead in the vehicle's lane: what car-to-car tests and those along the lane share."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import Actors, Coordinates, Grade, Roads, World
from safevar_sumo.scenarios.euro_ncap import (
    ACROSS_ON,
    AHEAD,
    APPROACH,
    BODIES,
    INSIDE,
    KMH,
    TARGET,
    VUT_LENGTH,
    VUT_WIDTH,
    Body,
    Direction,
    ImpactLocation,
    lanes_across,
    lateral_of,
    target_type,
)
from safevar_sumo.scenarios.frame import Frame
from safevar_sumo.scenarios.target import Course, Target, TargetTest, Times, at

ROAD = "road_0"
START = 50.0
"""Place of the vehicle's front bumper on the lane at the start [m]."""
BEYOND = 0.5
"""How far the front of a target that stands askew is on the lane beyond the junction [m]: nobody departs on a junction itself."""


class Ahead(NamedTuple):
    """A target at a gap [m] before a vehicle, with a speed over time [m/s at s].

    The middle of its rear is at an offset to the right [m]; there it may stand askew, its front in a direction.
    """

    target: str
    vut: Body
    gap: float
    offset: float
    speed: Callable[[float], float]
    direction: Direction = AHEAD

    def lanes(self, roads: Roads) -> Actors:
        """The lane across in the direction of a target that stands askew: its rear on the junction, its front on the lane beyond."""
        if not self._askew:
            return {}
        frame, (forth, left), length = Frame.of(roads.lane(APPROACH)), self.direction, self._body.length
        rear = frame.place_of(roads.lane(INSIDE).start)[0], -self.offset
        entry, exit_ = ((rear[0] + way * forth, rear[1] + way * left) for way in (-length, length - BEYOND))
        return lanes_across(frame, entry, exit_, self.direction)

    def actors(self, speed: float, roads: Roads) -> Actors:
        """The vehicle at `speed` [m/s], and the target in front of it."""
        if self.gap <= 0:
            raise InputError("scenario.parameters", f"the target begins {-self.gap:.2f} m inside the vehicle", "a target ahead")
        place, target = self._placed(roads) if self._askew else self._in_line()
        return {
            "vType[@id='vut']": {"length": repr(self.vut.length), "width": repr(self.vut.width)},
            "vehicle[@id='vut']": {"departPos": repr(place), "departSpeed": repr(speed)},
            **target,
        }

    def _in_line(self) -> tuple[float, Actors]:
        """Where the vehicle starts on the straight road [m], and the target there."""
        kind = TYPES.get(self.target, self.target)
        renamed = {f"vType[@id='{kind}']": target_type(self.target)} if kind != self.target else {}
        return START, {**renamed, "vehicle[@id='target']": {
            "type": self.target, "departPos": repr(START + self.gap + self._body.length), "departPosLat": repr(-self.offset),
            "departSpeed": repr(self.speed(0.0))}}

    def _placed(self, roads: Roads) -> tuple[float, Actors]:
        """Where the vehicle starts before the junction [m], and the target there."""
        along, _ = Frame.of(roads.lane(APPROACH)).place_of(roads.lane(ACROSS_ON).start)
        place = along + BEYOND * self.direction.along - self._depth - self.gap
        if place - self.vut.length < 0:
            raise InputError("scenario.parameters", f"a gap of {self.gap:.0f} m begins before the road does")
        parked = {f"vehicle[@id='parked_{size}']": None for size in ("small", "large")}
        return place, {**parked, "vType[@id='target']": target_type(self.target), "vehicle[@id='target']": {
            "type": self.target, "route": "beyond", "departPos": repr(BEYOND), "departPosLat": "0", "departSpeed": "0"}}

    def meeting(self, world: World) -> _Meeting:
        """The meeting of vehicles with it."""
        return _Meeting(Frame.of(world.lane(APPROACH if self._askew else ROAD)), Course(follows=True), self, self._depth)

    @property
    def _askew(self) -> bool:
        return self.direction != AHEAD

    @property
    def _body(self) -> Body:
        return BODIES[self.target]

    @property
    def _depth(self) -> float:
        """From the middle of its front back along the lane to what the vehicle reaches first [m]."""
        if not self._askew:
            return self._body.length
        (forth, left), half = self.direction, self._body.width / 2
        front = self._body.length * forth, self._body.length * left - self.offset
        rear = 0.0, -self.offset
        corners = [(x - sign * left * half, y + sign * forth * half) for x, y in (rear, front) for sign in (1, -1)]
        return front[0] - _nearest([corners[0], corners[1], corners[3], corners[2]], self.vut.width / 2)


class _Meeting(NamedTuple):
    """A vehicle behind the target, which it reaches so far behind the target's front [m]; see `Meeting`."""

    frame: Frame
    course: Course
    ahead: Ahead
    depth: float

    def begin(self, world: World) -> float:
        pace = self.ahead.speed(0.0)
        world.drive(TARGET, pace)
        return pace

    def positions(self, world: World) -> FloatArray:
        return world.vehicle_positions(TARGET)

    def target(self, positions: FloatArray, times: Times) -> Target:
        along = self.frame.along(positions)
        return Target(along - self.depth, np.full_like(along, self.ahead.offset), speed=at(times, self.ahead.speed))

    def pace(self, sample: int, step: float) -> float:
        return self.ahead.speed((sample + 1) * step)

    def go(self, world: World, pace: float) -> None:
        world.drive(TARGET, pace)


TYPES = {"cyclist": "adult", "motorcyclist": "car"}
"""The traffic's types whose place those take that it does not have."""


def _nearest(corners: list[Coordinates], half: float) -> float:
    """The least place along a lane of a body between both sides of a vehicle, `half` from the middle; of all of it, if it is beside [m]."""
    places = [x for x, y in corners if abs(y) <= half]
    for (x, y), (to_x, to_y) in pairwise([*corners, corners[0]]):
        places += [x + (to_x - x) * (side - y) / (to_y - y) for side in (-half, half) if (y - side) * (to_y - side) < 0]
    return min(places or [x for x, _ in corners])


class BehindSomebody(TargetTest, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario with somebody ahead.

    Parameters
    ----------
    speed
        The vehicle's at the start [km/h].
    impact_location
        Where on the vehicle's front the middle of the target's rear would be hit, from its left corner [% of the width].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].
    """

    speed: Annotated[float, Meta(gt=0, le=250)]
    impact_location: ImpactLocation = 50.0
    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0

    def lanes(self, roads: Roads) -> Actors:
        """The lane across of a target that stands askew."""
        return self._ahead.lanes(roads)

    def actors(self, roads: Roads) -> Actors:
        """The vehicle at its speed, and the target."""
        return self._ahead.actors(self.test_speed, roads)

    def _meeting(self, world: World) -> _Meeting:
        return self._ahead.meeting(world)

    def encounter(self, trace: Trace) -> Encounter:
        """Distances from bumper to body; TTC is that gap over the difference of speeds."""
        return Encounter(separation=trace.gap, distance=trace.gap, closing_speed=trace.speed - trace.obstacle_speed,
                         in_conflict=trace.gap > 0)

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    def _ahead_of(self, target: str, gap: float, speed: Callable[[float], float], direction: Direction = AHEAD) -> Ahead:
        """A target at the impact location."""
        vut = Body(self.vut_length, self.vut_width)
        return Ahead(target, vut, gap, lateral_of(self.impact_location, self.vut_width), speed, direction)

    @property
    def _ahead(self) -> Ahead:
        raise NotImplementedError
