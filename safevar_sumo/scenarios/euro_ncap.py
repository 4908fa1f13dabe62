"""Euro NCAP's frontal crash avoidance tests (protocol CA-FC, v1.2, July 2026): what their scenarios share.

It is the protocol's table, targets and their directions, and how targets move in SUMO.

Speeds are in km/h and impact locations in per cent of the vehicle's width, as in the protocol.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import KMH_PER_MS, FloatArray
from safevar_sumo.scenarios.base import (
    CROSSING_LANE,
    PEDESTRIAN,
    Coordinates,
    Frame,
    PreCrash,
    Roads,
    World,
    XmlChanges,
    as_text,
)
from safevar_sumo.shipped import shipped_table

KMH = 1 / KMH_PER_MS
"""m/s per km/h."""
VUT_LENGTH, VUT_WIDTH = 4.9016, 2.1284
"""Bounding box of CARLA's vehicle.lincoln.mkz2017 [m]."""
Metres = Annotated[float, Meta(ge=0, le=100)]
Seconds = Annotated[float, Meta(gt=0, le=60)]
Speed = Annotated[float, Meta(gt=0, le=250)]
"""Speed of a vehicle under test [km/h]."""
ImpactLocation = Annotated[float, Meta(ge=-50, le=150)]
"""Point on or beside the vehicle's front [% of its width]."""
Heading = Annotated[float, Meta(ge=-30, le=30)]
"""Rotation of a target's path, counterclockwise seen from above [degrees]."""


class BodySize(NamedTuple):
    """Size of a body [m]: length in the direction of motion, width across."""

    length: float
    width: float


BODIES = {
    "adult": BodySize(0.6, 0.5),
    "child": BodySize(0.711, 0.298),
    "cyclist": BodySize(1.9, 0.5),
    "motorcyclist": BodySize(2.1, 0.8),
    "car": BodySize(4.023, 1.712),
}
"""Bounding boxes of Euro NCAP's targets, including riders [m]."""
SHAPES = {
    "adult": "pedestrian",
    "child": "pedestrian",
    "cyclist": "bicycle",
    "motorcyclist": "motorcycle",
    "car": "evehicle",
}
"""Shapes that sumo-gui draws for the targets; SUMO does not cut off the corners of these shapes."""
TARGET_TOP_SPEED = "70"
"""Highest speed of a target [m/s]."""


class Direction(NamedTuple):
    """Direction of a target as a unit vector, along the vehicle's lane and to its left."""

    along: float
    left: float

    def turned(self, heading: float) -> Direction:
        """The direction turned counterclockwise by `heading` [degrees].

        Sine and cosine are rounded, as their last bits differ between machines.
        """
        cosine, sine = (round(function(math.radians(heading)), 12) for function in (math.cos, math.sin))
        return Direction(self.along * cosine - self.left * sine, self.left * cosine + self.along * sine)

    def extent(self, body: BodySize) -> BodySize:
        """Size along the lane and across it of a body that faces in this direction [m]."""
        along, left = abs(self.along), abs(self.left)
        return BodySize(body.length * along + body.width * left, body.length * left + body.width * along)


SAME_DIRECTION, FROM_RIGHT, FROM_LEFT = Direction(1.0, 0.0), Direction(0.0, 1.0), Direction(0.0, -1.0)
TARGET = "target"
"""Id of the target in every network where it is a vehicle."""
JUNCTION = "junction"
"""The network in which a target has lanes of its own, in any direction."""
VUT_LANE = "approach_0"
"""The vehicle's lane before the junction."""
ENTRY_LANE, JUNCTION_LANE, EXIT_LANE = "across_0", ":junction_0_0", "across_on_0"
"""The target's lanes: before the junction, on it, and beyond."""
TARGET_LANE_LENGTH = 300.0
"""Length of the target's lanes before the junction and beyond it [m]."""


def approach(roads: Roads | World) -> Frame:
    """The coordinates of the vehicle's lane before the junction."""
    return Frame.of(roads.lane(VUT_LANE))


def change_target_lanes(frame: Frame, entry: Coordinates, exit_: Coordinates, direction: Direction) -> XmlChanges:
    """Changes that make the target's lanes straight in a direction, from `entry` to `exit_` on the junction.

    These points are distances along the vehicle's lane and to its left [m].
    """
    begin, end = (
        (along + distance * direction.along, left + distance * direction.left)
        for (along, left), distance in ((entry, -TARGET_LANE_LENGTH), (exit_, TARGET_LANE_LENGTH))
    )
    return {
        f"edge/lane[@id='{lane}']": {
            "shape": " ".join(",".join(map(repr, frame.point(*point))) for point in ends),
            "length": repr(math.dist(*ends)),
        }
        for lane, ends in ((ENTRY_LANE, (begin, entry)), (JUNCTION_LANE, (entry, exit_)), (EXIT_LANE, (exit_, end)))
    }


def target_type(target: str) -> dict[str, str]:
    """Attributes of the target's vehicle type in the traffic file."""
    body = BODIES[target]
    return {
        "id": target,
        "length": repr(body.length),
        "width": repr(body.width),
        "guiShape": SHAPES[target],
        "maxSpeed": TARGET_TOP_SPEED,
    }


class TestRow(Struct, frozen=True, forbid_unknown_fields=True):
    """A row of the protocol's table.

    Attributes
    ----------
    target, pre_crash
        The target, and the pre-crash type of the encounter.
    slowest, fastest, locations
        Tested speeds of the vehicle [km/h] and impact locations [% of the width].
    target_speed, acceleration_distance
        Speed of the target [km/h] and distance within which it reaches that speed [m].
    side, lateral_start, hidden
        Of a crossing target: where it starts [m], and whether parked cars hide it. A target without a `lateral_start`
        starts at its full speed.
    headway
        Of a car or motorcyclist ahead: time headway at the start [s].
    """

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
"""The rows of the protocol's table: euro_ncap.toml beside this module."""


class SpeedProfile(NamedTuple):
    """Speed over time of a target that stands, sets off at `begin` [s], and accelerates evenly to `speed` [m/s] within
    `run_up` [m]; or of N targets, in arrays.
    """

    begin: Any
    speed: Any
    run_up: float

    @classmethod
    def with_arrival(cls, distance: Any, time: Any, speed: Any, run_up: float) -> SpeedProfile:
        """The profile that covers `distance` [m] by `time` [s].

        Past the run-up, distance = speed * (time - begin) - run_up.
        """
        if np.any(distance < run_up):
            raise InputError(
                "scenario.parameters",
                f"acceleration_distance = {run_up:g} m is longer than the distance of {np.min(distance):g} m",
            )
        shortest_time = (distance + run_up) / speed
        begin = time - shortest_time
        if np.any(begin < 0):
            raise InputError(
                "scenario.parameters",
                f"the target needs {np.max(shortest_time):.2f} s to the impact and has {np.max(time):g} s",
                "a faster target, a shorter distance or a longer time_to_impact",
            )
        return cls(begin, speed, run_up)

    @np.errstate(all="ignore")  # where there is no run-up
    def travelled(self, time: Any) -> Any:
        """Distance covered [m] at a time [s]."""
        elapsed = np.maximum(time - self.begin, 0.0)
        return np.where(
            elapsed >= 2 * self.run_up / self.speed,  # twice the time that the run-up would take at full speed
            self.speed * elapsed - self.run_up,
            self.speed * self.speed / (4 * np.float64(self.run_up)) * elapsed * elapsed,
        )[()]

    @np.errstate(all="ignore")
    def speed_at(self, time: Any) -> Any:
        """Speed [m/s] at a time [s]."""
        elapsed = time - self.begin
        rising = self.speed * self.speed / (2 * np.float64(self.run_up)) * elapsed
        steady = np.where(elapsed >= 2 * self.run_up / self.speed, self.speed, rising)
        return np.where(elapsed < 0, 0.0, steady)[()]


def lateral_offset(location: Any, width: float) -> Any:
    """Distance of an impact location [% of `width`] from the middle of the front [m].

    It is below 0 on the side from which `location` counts.
    """
    return (location / 100 - 0.5) * width


WALK_EDGES = {1.0: ("footpath", "footpath_on"), -1.0: ("footpath_on", "footpath")}
"""Edges that a pedestrian walks on, in this order, to the left of the vehicle (key 1.0) or to its right (-1.0)."""
STOP_DISTANCE = 5.0
"""Distance past the middle of the lane at which a pedestrian stops [m]."""


LEAST_WALKING_SPEED = 0.001
"""Speed below which SUMO's persons stand [m/s] (utils/common/StdDefs.h, NUMERICAL_EPS)."""


class PersonMover(NamedTuple):
    """A pedestrian who walks to the left (`sign` 1) or right (-1), from the position `start` to `stop` [m].

    Positions are distances from the lane's middle in the direction of the walk.
    """

    target: str
    sign: float
    start: float
    profile: SpeedProfile
    stop: float = STOP_DISTANCE

    def lanes(self, frame: Frame, roads: Roads) -> XmlChanges:
        """No changes: the pedestrian uses the network's footpath."""
        return {}

    def impact_position(self, frame: Frame, roads: Roads | World, impact_left: Any) -> Any:
        """Position of the target's middle along the lane when the target is `impact_left` metres to the left of the
        lane's middle [m].
        """
        return frame.lane_coordinates(roads.lane(CROSSING_LANE).start)[0]

    def actors(self, frame: Frame, roads: Roads, impact_left: float, distance: float) -> XmlChanges:
        """The pedestrian beside the lane, `distance` metres before the impact."""
        edges = WALK_EDGES[self.sign]
        for lane in (CROSSING_LANE, *(f"{edge}_0" for edge in edges)):
            frame.crossing_position(roads, lane)  # raises if it does not cross at right angles
        path, half_length = roads.lane(f"{edges[0]}_0"), BODIES[self.target].length / 2
        ends = [self.sign * frame.lane_coordinates(point)[1] for point in (path.start, path.end)]
        front = half_length + self.start
        if not min(ends) <= front <= max(ends):
            problem = f"lateral_start = {-self.start:g} m is not on the footpath"
            expected = f"a number in [{half_length - max(ends):.2f}, {half_length - min(ends):.2f}] m"
            raise InputError("scenario.parameters", problem, expected)
        person = {"type": self.target, "departPos": as_text(abs(front - ends[0]))}
        # One metre before the end of the last edge (-1); a walk to the right goes along it backwards, to metre 1.
        arrival_position = -int(self.sign)
        walk = {"edges": " ".join(edges), "speed": as_text(self.profile.speed), "arrivalPos": repr(arrival_position)}
        return {"person[@id='pedestrian']": person, "person[@id='pedestrian']/walk": walk}

    @property
    def initial_speed(self) -> float:
        """0: the pedestrian stands at first [m/s]."""
        return 0.0

    def positions(self, world: World) -> FloatArray:
        """Position of the target's front in SUMO; shape (N, 2) [m]."""
        return world.person_positions(PEDESTRIAN)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Position of the target's middle along the lane and to its left [m], from `positions` of the front.

        The first is None: a pedestrian is always at the impact position along the lane.
        """
        return None, frame.left(positions) - self.sign * BODIES[self.target].length / 2

    def next_speed(self, sample: int, step: float) -> Any:
        """Mean speed in the coming step [m/s]."""
        walked, next_walked = (self.walked(k * step) for k in (sample, sample + 1))
        return (next_walked - walked) / step

    def walked(self, time: Any) -> Any:
        """Distance walked [m] at a time [s]."""
        return np.minimum(self.profile.travelled(time), self.stop - self.start)

    def path(self, times: Any, step: float) -> tuple[FloatArray, FloatArray]:
        """Distances from the middle of the lane in the direction of the walk [m], of the target's front at times
        [s], and its mean speeds in the steps before them [m/s].
        """
        walked = self.walked(times)
        mean_speeds = np.diff(walked, axis=0, prepend=walked[:1]) / step
        mean_speeds = np.where(mean_speeds < LEAST_WALKING_SPEED, 0.0, mean_speeds)
        front = self.start + BODIES[self.target].length / 2
        return front + np.add.accumulate(mean_speeds * step, axis=0), mean_speeds

    def set_speed(self, world: World, speed: Any) -> None:
        world.walk(PEDESTRIAN, speed)


class VehicleMover(NamedTuple):
    """A target that drives on lanes that lead in its direction; `speed_at` maps a time [s] to its speed [m/s]."""

    target: str
    direction: Direction
    speed_at: Callable[[Any], Any]

    def lanes(self, frame: Frame, roads: Roads) -> XmlChanges:
        """Changes that rotate the target's lanes around their crossing with the vehicle's lane; none for a target from
        the right.
        """
        if self.direction == FROM_RIGHT:
            return {}
        lane = roads.lane(JUNCTION_LANE)
        along, start_left = frame.lane_coordinates(lane.start)
        _, end_left = frame.lane_coordinates(lane.end)
        ahead, leftward = ((end_left - start_left) / 2 * component for component in self.direction)
        return change_target_lanes(frame, (along - ahead, -leftward), (along + ahead, leftward), self.direction)

    def impact_position(self, frame: Frame, roads: Roads | World, impact_left: Any) -> Any:
        """Position of the target's middle along the lane when the target is `impact_left` metres to the left of the
        lane's middle [m].
        """
        along, left = frame.lane_coordinates(roads.lane(ENTRY_LANE).end)
        return along + (impact_left - left) * self.direction.along / self.direction.left

    def actors(self, frame: Frame, roads: Roads, impact_left: float, distance: float) -> XmlChanges:
        """The target on its lane, `distance` metres before the impact."""
        lane = roads.lane(ENTRY_LANE)
        lane_start = self._along(frame, lane.start)
        impact_along = self.impact_position(frame, roads, impact_left)
        impact_on_path = impact_along * self.direction.along + impact_left * self.direction.left
        front = impact_on_path - lane_start - distance + BODIES[self.target].length / 2
        length = self._along(frame, lane.end) - lane_start
        if not 0 < front <= length:
            raise InputError(
                "scenario.parameters",
                f"the target starts {distance:.2f} m before the impact, where it has no lane",
                f"a start from {distance - (length - front):.2f} to {distance + front:.2f} m before it",
            )
        return {
            "vType[@id='target']": target_type(self.target),
            "vehicle[@id='target']": {
                "type": self.target,
                "departPos": as_text(front),
                "departSpeed": as_text(self.initial_speed),
            },
        }

    def _along(self, frame: Frame, point: Coordinates) -> float:
        """Position of a point along the target's direction [m]."""
        along, left = frame.lane_coordinates(point)
        return along * self.direction.along + left * self.direction.left

    @property
    def initial_speed(self) -> Any:
        """Speed at the start [m/s]."""
        return self.speed_at(0.0)

    def positions(self, world: World) -> FloatArray:
        """Position of the target's front in SUMO; shape (N, 2) [m]."""
        return world.vehicle_positions(TARGET)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Position of the target's middle along the lane and to its left [m], from `positions` of the front."""
        half_length = BODIES[self.target].length / 2
        along = frame.along(positions) - self.direction.along * half_length
        return along, frame.left(positions) - self.direction.left * half_length

    def next_speed(self, sample: int, step: float) -> Any:
        """Speed at the end of the coming step [m/s]."""
        return self.speed_at((sample + 1) * step)

    def set_speed(self, world: World, speed: Any) -> None:
        world.drive(TARGET, speed)
