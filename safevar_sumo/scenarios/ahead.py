"""Euro NCAP's tests with a target ahead in the vehicle's lane.

A pedestrian (CPLA) or a cyclist (CBLA) moves along the lane. A car stands (CCRs), is slower (CCRm) or brakes (CCRb); a
motorcyclist stands (CMRs) or brakes (CMRb).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from msgspec.structs import force_setattr

from safevar_sumo.errors import InputError
from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import (
    Coordinates,
    Frame,
    Layout,
    PreCrash,
    Roads,
    World,
    XmlChanges,
    as_text,
    driven_distance,
)
from safevar_sumo.scenarios.euro_ncap import (
    BODIES,
    EXIT_LANE,
    JUNCTION,
    JUNCTION_LANE,
    KMH,
    SAME_DIRECTION,
    TARGET,
    VUT_LANE,
    BodySize,
    Direction,
    Heading,
    Metres,
    Seconds,
    Speed,
    SpeedProfile,
    VehicleMover,
    approach,
    change_target_lanes,
    lateral_offset,
    target_type,
)
from safevar_sumo.scenarios.target import EncounterConstants, Target, TargetMotion, TargetTest, Times, value_at

ROAD_LANE = "road_0"
START_POSITION = 50.0
"""Position of the vehicle's front bumper on the lane at the start [m]."""
FRONT_POSITION = 0.5
"""Position of a rotated target's front on the lane beyond the junction [m]; SUMO cannot insert a vehicle on the
junction itself.
"""
REPLACED_TYPES = {"cyclist": "adult", "motorcyclist": "car"}
"""Targets that have no type in the traffic file, each with the type there that it replaces."""
FINAL_SPEED = 2.0
"""Speed at which the braking target stops braking [km/h]."""
STEADY_SPEED_LIMIT = 80.0
"""Speed of the vehicle up to which the slower target drives at 20 km/h [km/h]; above it, the target is 60 km/h slower.
"""


class TargetAhead(TargetTest, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario with a target ahead in the vehicle's lane; for its parameters see `TargetTest`.

    The middle of the target's rear is at the impact location. A standing target may be rotated around that point.
    """

    @property
    def gap(self) -> Any:
        """Gap to the target at the start [m]."""
        raise NotImplementedError

    @property
    def target_speed_at(self) -> Callable[[Any], Any]:
        """The target's speed [m/s] as a function of the time [s]."""
        raise NotImplementedError

    @property
    def offset(self) -> Any:
        """Distance of the target's rear to the right of the lane's middle [m]."""
        return lateral_offset(self.impact_location, self.vut_width)

    @property
    def direction(self) -> Direction:
        """Direction of the target."""
        return SAME_DIRECTION

    @property
    def _body(self) -> BodySize:
        return BODIES[self.parameter("target")]

    def lanes(self, roads: Roads) -> XmlChanges:
        """Changes that turn the lanes into a rotated target's direction; its rear is on the junction, and its front on
        the exit lane.
        """
        direction = self.direction
        if direction == SAME_DIRECTION:
            return {}
        frame, length = approach(roads), self._body.length
        rear_along, rear_left = frame.lane_coordinates(roads.lane(JUNCTION_LANE).start)[0], -self.offset
        entry, exit_ = (
            (rear_along + distance * direction.along, rear_left + distance * direction.left)
            for distance in (-length, length - FRONT_POSITION)
        )
        return change_target_lanes(frame, entry, exit_, direction)

    def actors(self, roads: Roads) -> XmlChanges:
        """The vehicle at its speed, and the target ahead of it: in line with the lane, or rotated on the junction."""
        name, direction = self.parameter("target"), self.direction
        if self.gap <= 0:
            raise InputError(
                "scenario.parameters", f"the target begins {-self.gap:.2f} m inside the vehicle", "a target ahead"
            )
        if direction == SAME_DIRECTION:
            replaced = REPLACED_TYPES.get(name)
            return {
                **self._vehicle_at(START_POSITION),
                **({f"vType[@id='{replaced}']": target_type(name)} if replaced else {}),
                "vehicle[@id='target']": {
                    "type": name,
                    "departPos": as_text(START_POSITION + self.gap + self._body.length),
                    "departPosLat": as_text(-self.offset),
                    "departSpeed": as_text(self.target_speed_at(0.0)),
                },
            }
        exit_along, _ = approach(roads).lane_coordinates(roads.lane(EXIT_LANE).start)
        rotated = {"type": name, "route": "beyond", "departPos": repr(FRONT_POSITION)}
        return {
            **self._vehicle_at(exit_along + FRONT_POSITION * direction.along - self._depth - self.gap),
            **{f"vehicle[@id='parked_{size}']": None for size in ("small", "large")},
            "vType[@id='target']": target_type(name),
            "vehicle[@id='target']": {**rotated, "departPosLat": "0", "departSpeed": "0"},
        }

    def layout(self, roads: Roads, step: float, samples: int) -> Layout:
        times = np.arange(samples)[:, np.newaxis] * step
        speeds = self.target_speed_at(times) + np.zeros_like(times)
        along = START_POSITION + self.gap + self._body.length + driven_distance(speeds, step)
        frame = Frame.of(roads.lane(ROAD_LANE))
        return Layout(frame, None, self.test_speed, TARGET, along, np.asarray(-self.offset), speeds)

    def _motion(self, world: World) -> TargetMotion:
        direction, depth, offset, speed_at = self.direction, self._depth, self.offset, self.target_speed_at
        frame = Frame.of(world.lane(ROAD_LANE if direction == SAME_DIRECTION else VUT_LANE))

        def target(positions: FloatArray, times: Times) -> Target:
            along = frame.along(positions)
            return Target(along - depth, np.full_like(along, offset), speed=value_at(times, speed_at))

        mover = VehicleMover(self.parameter("target"), direction, speed_at)
        return TargetMotion(frame, EncounterConstants(follows=True), mover, target)

    @property
    def _depth(self) -> float:
        """Distance along the lane from the first point of contact to the middle of the target's front [m]."""
        (along, left), (length, width) = self.direction, self._body
        if self.direction == SAME_DIRECTION:
            return length
        front, rear = (length * along, length * left - self.offset), (0.0, -self.offset)
        ends_and_sides = ((rear, 1), (rear, -1), (front, -1), (front, 1))  # 1 is the left side; once around the body
        corners = [(x - side * left * (width / 2), y + side * along * (width / 2)) for (x, y), side in ends_and_sides]
        return front[0] - _first_contact_position(corners, self.vut_width / 2)

    def encounter(self, trace: Trace) -> Encounter:
        """Distance from the front bumper to the target's body; TTC is this distance over the difference of speeds."""
        return Encounter(
            separation=trace.gap,
            distance=trace.gap,
            closing_speed=trace.speed - trace.obstacle_speed,
            in_conflict=trace.gap > 0,
        )


def _first_contact_position(corners: list[Coordinates], half_width: float) -> float:
    """Position along the lane at which a vehicle of this half width first touches a body with these corners [m].

    If the body is beside the vehicle's path: the position of its rearmost corner.
    """
    positions = [x for x, y in corners if abs(y) <= half_width]
    for (x, y), (to_x, to_y) in pairwise([*corners, corners[0]]):
        positions += [
            x + (to_x - x) * (path_edge - y) / (to_y - y)
            for path_edge in (-half_width, half_width)
            if min(y, to_y) < path_edge < max(y, to_y)
        ]
    return min(positions or [x for x, _ in corners])


class Along(TargetAhead, frozen=True, kw_only=True):
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
    target: Literal["adult", "child", "cyclist"] | None = None
    target_speed: Annotated[float, Meta(gt=0, le=60)] | None = None
    acceleration_distance: Metres | None = None
    time_to_impact: Seconds = 6.0
    network: str = "along"

    def obstacle(self) -> str:
        """The target, which is ahead."""
        return f"{super().obstacle()} ahead"

    @property
    def duration(self) -> Any:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    @property
    def gap(self) -> Any:
        """Gap to the target at the start, which closes in the time to impact [m]."""
        return self.test_speed * self.time_to_impact - self._profile.travelled(self.time_to_impact)

    @property
    def target_speed_at(self) -> Callable[[Any], Any]:
        """The target's speed [m/s] as a function of the time [s]."""
        return self._profile.speed_at

    @property
    def _profile(self) -> SpeedProfile:
        return SpeedProfile(0.0, self.parameter("target_speed") * KMH, self.parameter("acceleration_distance"))


class CarToCar(TargetAhead, frozen=True, kw_only=True):
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
    speed: Speed = 50.0
    target_speed: Annotated[float, Meta(ge=0, le=250)] | None = None
    headway: Seconds | None = None
    brakes_at: Annotated[float, Meta(ge=0, le=60)] = 3.0
    target_deceleration: Annotated[float, Meta(gt=0, le=12)] = 4.0
    heading: Heading = 0.0
    time_after: Seconds = 5.0

    def __post_init__(self) -> None:
        if not self.network:
            force_setattr(self, "network", JUNCTION if self.heading else "car_to_car")

    @property
    def duration(self) -> Any:
        """Length of a run [s]."""
        return self._time_to_impact() + self.time_after

    @property
    def gap(self) -> Any:
        """Gap to the target at the start [m]."""
        return self.parameter("headway") * self.speed * KMH

    @property
    def direction(self) -> Direction:
        """Direction of the target."""
        if self.heading and self._target_speed:
            problem = f"heading = {self.heading:g} with a moving target"
            raise InputError("scenario.parameters", problem, "a heading for a standing target")
        return SAME_DIRECTION.turned(self.heading)

    @property
    def _target_brakes(self) -> bool:
        return self.pre_crash == PreCrash.LEAD_DECELERATING

    @property
    def _target_speed(self) -> Any:
        """Speed of the target at the start [m/s]."""
        slower_speed = 20.0 + np.maximum(self.speed - STEADY_SPEED_LIMIT, 0.0)
        default = {PreCrash.LEAD_STOPPED: 0.0, PreCrash.LEAD_SLOWER: slower_speed}.get(self.pre_crash, self.speed)
        return (default if self.target_speed is None else self.target_speed) * KMH

    @property
    def target_speed_at(self) -> Callable[[Any], Any]:
        """The target's speed [m/s] as a function of the time [s]."""
        first_speed, brakes_at, deceleration = self._target_speed, self.brakes_at, self.target_deceleration
        if not self._target_brakes:
            return lambda time: first_speed
        last_speed = np.minimum(first_speed, FINAL_SPEED * KMH)
        return lambda time: np.maximum(first_speed - deceleration * np.maximum(time - brakes_at, 0.0), last_speed)

    @np.errstate(all="ignore")  # of the speeds that do not count
    def _time_to_impact(self) -> Any:
        """Time to the impact if the vehicle does not brake [s].

        The gap closes at a constant speed. A target that brakes at b m/s^2 makes this speed rise by b per second until
        it stops braking.
        """
        closing_speed, gap = self.test_speed - self._target_speed, self.gap
        if not self._target_brakes:
            if np.any(closing_speed <= 0):
                problem = f"speed = {np.min(self.speed):g} km/h never reaches the target"
                raise InputError("scenario.parameters", problem, "a slower target")
            return gap / closing_speed
        gap_at_braking = gap - closing_speed * self.brakes_at
        b, speed_lost = self.target_deceleration, self._target_speed - self.target_speed_at(math.inf)
        closed_by_braking = (closing_speed + speed_lost / 2) * speed_lost / b
        gap_after_braking = gap_at_braking - closed_by_braking
        after_braking = self.brakes_at + speed_lost / b + gap_after_braking / (closing_speed + speed_lost)
        root = np.sqrt(closing_speed * closing_speed + 2 * b * gap_at_braking)
        in_braking = self.brakes_at + (root - closing_speed) / b
        braking = np.where(gap_at_braking > closed_by_braking, after_braking, in_braking)
        return np.where(gap_at_braking <= 0, gap / np.float64(closing_speed), braking)[()]
