"""A target ahead in the vehicle's lane: what `car_to_car` and `along` share, and Euro NCAP's tests with a pedestrian
(CPLA) or a cyclist (CBLA) who moves along the lane.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import Coordinates, Frame, Grade, PreCrash, Roads, World, XmlChanges
from safevar_sumo.scenarios.euro_ncap import (
    BODIES,
    EXIT_LANE,
    JUNCTION_LANE,
    KMH,
    SAME_DIRECTION,
    VUT_LANE,
    VUT_LENGTH,
    VUT_WIDTH,
    BodySize,
    Direction,
    ImpactLocation,
    ProtocolRange,
    SpeedProfile,
    change_target_lanes,
    lateral_offset,
    target_type,
)
from safevar_sumo.scenarios.target import (
    EncounterConstants,
    Target,
    TargetMotion,
    TargetTest,
    Times,
    VehicleMover,
    value_at,
)

ROAD_LANE = "road_0"
START_POSITION = 50.0
"""Position of the vehicle's front bumper on the lane at the start [m]."""
FRONT_POSITION = 0.5
"""Position of a rotated target's front on the lane beyond the junction [m]; SUMO cannot insert a vehicle on the
junction itself.
"""


class TargetAhead(NamedTuple):
    """A target `gap` metres ahead of the vehicle under test; the function `speed_at` maps a time [s] to the target's
    speed [m/s].

    The middle of the target's rear is `offset` metres right of the lane's middle. A standing target may be rotated
    around that point.
    """

    target: str
    vut: BodySize
    gap: float
    offset: float
    speed_at: Callable[[float], float]
    direction: Direction = SAME_DIRECTION

    def lanes(self, roads: Roads) -> XmlChanges:
        """Changes that turn the lanes into a rotated target's direction; its rear is on the junction, and its front on
        the exit lane.
        """
        if not self._is_rotated:
            return {}
        frame, (along, left), length = Frame.of(roads.lane(VUT_LANE)), self.direction, self._body.length
        rear = frame.lane_coordinates(roads.lane(JUNCTION_LANE).start)[0], -self.offset
        entry, exit_ = (
            (rear[0] + distance * along, rear[1] + distance * left) for distance in (-length, length - FRONT_POSITION)
        )
        return change_target_lanes(frame, entry, exit_, self.direction)

    def actors(self, vut_speed: float, roads: Roads) -> XmlChanges:
        """The vehicle at `vut_speed` [m/s], and the target ahead of it."""
        if self.gap <= 0:
            raise InputError(
                "scenario.parameters", f"the target begins {-self.gap:.2f} m inside the vehicle", "a target ahead"
            )
        start, target = self._place_at_junction(roads) if self._is_rotated else self._place_in_lane()
        return {
            "vType[@id='vut']": {"length": repr(self.vut.length), "width": repr(self.vut.width)},
            "vehicle[@id='vut']": {"departPos": repr(start), "departSpeed": repr(vut_speed)},
            **target,
        }

    def _place_in_lane(self) -> tuple[float, XmlChanges]:
        """The vehicle's start on the straight road [m], and a target in line with the lane."""
        old_type = REPLACED_TYPES.get(self.target, self.target)
        new_type = {f"vType[@id='{old_type}']": target_type(self.target)} if old_type != self.target else {}
        return START_POSITION, {
            **new_type,
            "vehicle[@id='target']": {
                "type": self.target,
                "departPos": repr(START_POSITION + self.gap + self._body.length),
                "departPosLat": repr(-self.offset),
                "departSpeed": repr(self.speed_at(0.0)),
            },
        }

    def _place_at_junction(self, roads: Roads) -> tuple[float, XmlChanges]:
        """The vehicle's start before the junction [m], and a rotated target on it."""
        along, _ = Frame.of(roads.lane(VUT_LANE)).lane_coordinates(roads.lane(EXIT_LANE).start)
        start = along + FRONT_POSITION * self.direction.along - self._depth - self.gap
        if start - self.vut.length < 0:
            raise InputError("scenario.parameters", f"a gap of {self.gap:.0f} m is longer than the road")
        parked = {f"vehicle[@id='parked_{size}']": None for size in ("small", "large")}
        return start, {
            **parked,
            "vType[@id='target']": target_type(self.target),
            "vehicle[@id='target']": {
                "type": self.target,
                "route": "beyond",
                "departPos": repr(FRONT_POSITION),
                "departPosLat": "0",
                "departSpeed": "0",
            },
        }

    def motion(self, world: World) -> TargetMotion:
        """The motion of the target in a run."""
        frame, depth = Frame.of(world.lane(VUT_LANE if self._is_rotated else ROAD_LANE)), self._depth

        def target(positions: FloatArray, times: Times) -> Target:
            along = frame.along(positions)
            return Target(along - depth, np.full_like(along, self.offset), speed=value_at(times, self.speed_at))

        mover = VehicleMover(self.target, self.direction, self.speed_at)
        return TargetMotion(frame, EncounterConstants(follows=True), mover, target)

    @property
    def _is_rotated(self) -> bool:
        return self.direction != SAME_DIRECTION

    @property
    def _body(self) -> BodySize:
        return BODIES[self.target]

    @property
    def _depth(self) -> float:
        """Distance along the lane from the first point of contact to the middle of the target's front [m]."""
        if not self._is_rotated:
            return self._body.length
        (along, left), half = self.direction, self._body.width / 2
        front = self._body.length * along, self._body.length * left - self.offset
        rear = 0.0, -self.offset
        corners = [(x - sign * left * half, y + sign * along * half) for x, y in (rear, front) for sign in (1, -1)]
        return front[0] - _first_contact_position([corners[0], corners[1], corners[3], corners[2]], self.vut.width / 2)


REPLACED_TYPES = {"cyclist": "adult", "motorcyclist": "car"}
"""Targets without a type in the traffic file, each with the type that it replaces."""


def _first_contact_position(corners: list[Coordinates], half_width: float) -> float:
    """Position along the lane at which a vehicle of this half width first touches a body with these corners [m].

    If the body is beside the vehicle's path: the position of its rearmost corner.
    """
    positions = [x for x, y in corners if abs(y) <= half_width]
    for (x, y), (to_x, to_y) in pairwise([*corners, corners[0]]):
        positions += [
            x + (to_x - x) * (edge - y) / (to_y - y)
            for edge in (-half_width, half_width)
            if (y - edge) * (to_y - edge) < 0
        ]
    return min(positions or [x for x, _ in corners])


class TargetAheadTest(TargetTest, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario with a target ahead in the lane.

    Parameters
    ----------
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the middle of the target's rear, from the left corner [% of the
        width].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].
    """

    speed: Annotated[float, Meta(gt=0, le=250)]
    impact_location: ImpactLocation = 50.0
    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0

    def lanes(self, roads: Roads) -> XmlChanges:
        """Changes to the lanes for a rotated target."""
        return self._target_ahead.lanes(roads)

    def actors(self, roads: Roads) -> XmlChanges:
        """The vehicle at its speed, and the target."""
        return self._target_ahead.actors(self.test_speed, roads)

    def _motion(self, world: World) -> TargetMotion:
        return self._target_ahead.motion(world)

    def encounter(self, trace: Trace) -> Encounter:
        """Distance from the front bumper to the target's body; TTC is this distance over the difference of speeds."""
        return Encounter(
            separation=trace.gap,
            distance=trace.gap,
            closing_speed=trace.speed - trace.obstacle_speed,
            in_conflict=trace.gap > 0,
        )

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    def _target_at_impact_location(
        self, target: str, gap: float, speed_at: Callable[[float], float], direction: Direction = SAME_DIRECTION
    ) -> TargetAhead:
        """The target with the middle of its rear at the impact location."""
        vut = BodySize(self.vut_length, self.vut_width)
        return TargetAhead(target, vut, gap, lateral_offset(self.impact_location, self.vut_width), speed_at, direction)

    @property
    def _target_ahead(self) -> TargetAhead:
        raise NotImplementedError


IMPACT_LOCATIONS = (50.0, 10.0, 25.0, 75.0, 90.0)
"""Impact locations [% of the width]."""


class _TestRow(NamedTuple):
    """A row of the protocol's table: target, its speed [km/h] and acceleration distance [m], tested range, pre-crash
    type.
    """

    target: str
    target_speed: float
    acceleration_distance: float
    protocol_range: ProtocolRange
    pre_crash: PreCrash


TESTS = {  # target, its speed, acceleration distance, range (slowest, fastest, impact locations), pre-crash type
    "CPLA": _TestRow("adult", 5.0, 1.0, ProtocolRange(10, 80, IMPACT_LOCATIONS), PreCrash.PEDESTRIAN),
    "CBLA": _TestRow("cyclist", 15.0, 0.0, ProtocolRange(20, 80, IMPACT_LOCATIONS), PreCrash.CYCLIST),
}


class Along(TargetAheadTest, frozen=True, kw_only=True):
    """A pedestrian or cyclist moves ahead in the vehicle's lane in its direction, and does not react to it.

    Parameters
    ----------
    test
        Row of the protocol, CPLA or CBLA: the source of parameters that are not set here.
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the target, from the left corner [% of the width].
    target, target_speed, acceleration_distance
        `adult`, `child` or `cyclist`; the target's speed [km/h], and the distance within which the target reaches that
        speed [m].
    time_to_impact, time_after
        Time from the start to the impact if nobody brakes, and time from the impact to the end of the run [s].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].

    Notes
    -----
    By default the cyclist rides at 15 km/h from the start; the protocol has 20 km/h in its rows that are rated by the
    warning.
    """

    test: Literal["CPLA", "CBLA"] = "CPLA"
    speed: Annotated[float, Meta(gt=0, le=250)] = 40.0
    target: Literal["adult", "child", "cyclist"] | None = None
    target_speed: Annotated[float, Meta(gt=0, le=60)] | None = None
    acceleration_distance: Annotated[float, Meta(ge=0, le=100)] | None = None
    time_to_impact: Annotated[float, Meta(gt=0, le=60)] = 6.0
    time_after: Annotated[float, Meta(gt=0, le=60)] = 4.0
    network: str = "along"

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's pre-crash type."""
        return TESTS[self.test].pre_crash

    def obstacle(self) -> str:
        """The target, which moves in the vehicle's direction."""
        return f"{super().obstacle()} ahead"

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].protocol_range.remarks(self.test, self.speed, self.impact_location, self.grade)

    @property
    def _target_ahead(self) -> TargetAhead:
        profile = SpeedProfile(
            begin=0.0, speed=self._parameter("target_speed") * KMH, run_up=self._parameter("acceleration_distance")
        )
        gap = self.speed * KMH * self.time_to_impact - profile.travelled(self.time_to_impact)
        return self._target_at_impact_location(self._parameter("target"), gap, profile.speed_at)

    def _parameter(self, name: str) -> Any:
        """A parameter as the study sets it, by default as the protocol does."""
        value = getattr(self, name)
        return getattr(TESTS[self.test], name) if value is None else value
