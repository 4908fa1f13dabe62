"""How SUMO moves a crossing target: a pedestrian who crosses at right angles on a footpath, any other target as a
vehicle on a lane.
"""

from __future__ import annotations

from typing import NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.base import Roads, World, XmlChanges
from safevar_sumo.scenarios.euro_ncap import (
    BODIES,
    ENTRY_LANE,
    FROM_RIGHT,
    JUNCTION_LANE,
    TARGET,
    Direction,
    SpeedProfile,
    change_target_lanes,
    target_type,
)
from safevar_sumo.scenarios.frame import MAX_SKEW, Frame

FOOTPATH_NETWORK = "crossing"
PEDESTRIAN = "pedestrian"
CROSSING_LANE = ":crossing_c0_0"
WALK_EDGES = {1.0: ("footpath", "footpath_on"), -1.0: ("footpath_on", "footpath")}
"""Edges that a pedestrian walks on, in this order; the key is 1.0 for a walk to the left of the vehicle, -1.0 to the
right.
"""
STOP_DISTANCE = 5.0
"""Distance past the middle of the lane at which a pedestrian stops [m]."""


class PersonMover(NamedTuple):
    """A pedestrian who walks to the left (`sign` 1) or right (-1); `start` is the position in this direction from the
    lane's middle [m].
    """

    target: str
    sign: float
    start: float

    def lanes(self, frame: Frame, roads: Roads) -> XmlChanges:
        """No changes: the pedestrian uses the network's footpath."""
        return {}

    def impact_position(self, frame: Frame, roads: Roads | World, impact_left: float) -> float:
        """Position of the target's middle along the lane when the target is `impact_left` metres to the left of the
        lane's middle [m].
        """
        return frame.lane_coordinates(roads.lane(CROSSING_LANE).start)[0]

    def actors(
        self, frame: Frame, roads: Roads, impact_left: float, distance: float, profile: SpeedProfile
    ) -> XmlChanges:
        """The pedestrian beside the lane, `distance` metres before the impact."""
        edges = WALK_EDGES[self.sign]
        for lane in (CROSSING_LANE, *(f"{edge}_0" for edge in edges)):
            first, last = (frame.lane_coordinates(point)[0] for point in roads.lane(lane))
            if abs(last - first) > MAX_SKEW:
                raise InputError(
                    "scenario.parameters.network",
                    f"lane {lane!r} leads {abs(last - first):.2f} m along the road",
                    "a crossing at right angles",
                )
        half_length = BODIES[self.target].length / 2
        edge_start, edge_end = (self.sign * frame.lane_coordinates(point)[1] for point in roads.lane(f"{edges[0]}_0"))
        start_position = half_length + self.start
        if not min(edge_start, edge_end) <= start_position <= max(edge_start, edge_end):
            nearest, farthest = half_length - max(edge_start, edge_end), half_length - min(edge_start, edge_end)
            raise InputError(
                "scenario.parameters",
                f"lateral_start = {-self.start:g} m is not on the footpath",
                f"a number in [{nearest:.2f}, {farthest:.2f}] m",
            )
        person = {"type": self.target, "departPos": repr(abs(start_position - edge_start))}
        walk = {"edges": " ".join(edges), "speed": repr(profile.speed), "arrivalPos": "-1" if self.sign > 0 else "1"}
        return {"person[@id='pedestrian']": person, "person[@id='pedestrian']/walk": walk}

    def begin(self, world: World, profile: SpeedProfile) -> float:
        """Make the pedestrian stand; returns 0, the initial speed [m/s]."""
        world.walk(PEDESTRIAN, 0.0)
        return 0.0

    def positions(self, world: World) -> FloatArray:
        """Position of the target's front in SUMO; shape (N, 2) [m]."""
        return world.person_positions(PEDESTRIAN)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Position of the target's middle along the lane (None: the impact position) and to the left [m], from
        `positions` of the front.
        """
        return None, frame.left(positions) - self.sign * BODIES[self.target].length / 2

    def next_speed(self, profile: SpeedProfile, sample: int, step: float) -> float:
        """Mean speed in the coming step [m/s]."""
        walking_distance = STOP_DISTANCE - self.start
        walked, next_walked = (min(profile.travelled(k * step), walking_distance) for k in (sample, sample + 1))
        return (next_walked - walked) / step

    def set_speed(self, world: World, speed: float) -> None:
        world.walk(PEDESTRIAN, speed)


class VehicleMover(NamedTuple):
    """A target that drives across the junction on lanes that lead in its direction."""

    target: str
    direction: Direction

    def lanes(self, frame: Frame, roads: Roads) -> XmlChanges:
        """Changes that rotate the target's lanes around their crossing with the vehicle's lane; none for a target from
        the right.
        """
        if self.direction == FROM_RIGHT:
            return {}
        (along, entry), (_, exit_) = (frame.lane_coordinates(point) for point in roads.lane(JUNCTION_LANE))
        (forward, left), half = self.direction, (exit_ - entry) / 2
        return change_target_lanes(
            frame, (along - half * forward, -half * left), (along + half * forward, half * left), self.direction
        )

    def impact_position(self, frame: Frame, roads: Roads | World, impact_left: float) -> float:
        """Position of the target's middle along the lane when the target is `impact_left` metres to the left of the
        lane's middle [m].
        """
        along, left = frame.lane_coordinates(roads.lane(ENTRY_LANE).end)
        return along + (impact_left - left) * self.direction.along / self.direction.left

    def actors(
        self, frame: Frame, roads: Roads, impact_left: float, distance: float, profile: SpeedProfile
    ) -> XmlChanges:
        """The target on its lane, `distance` metres before the impact."""
        lane, (forward, left) = roads.lane(ENTRY_LANE), self.direction
        lane_start = self._along(frame, lane.start)
        impact_on_path = self.impact_position(frame, roads, impact_left) * forward + impact_left * left
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
                "departPos": repr(front),
                "departSpeed": repr(profile.speed_at(0.0)),
            },
        }

    def _along(self, frame: Frame, point: tuple[float, float]) -> float:
        """Position of a point along the target's direction [m]."""
        along, left = frame.lane_coordinates(point)
        return along * self.direction.along + left * self.direction.left

    def begin(self, world: World, profile: SpeedProfile) -> float:
        """Set the target's initial speed; returns this speed [m/s]."""
        world.drive(TARGET, profile.speed_at(0.0))
        return profile.speed_at(0.0)

    def positions(self, world: World) -> FloatArray:
        """Position of the target's front in SUMO; shape (N, 2) [m]."""
        return world.vehicle_positions(TARGET)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Position of the target's middle along the lane and to the left [m], from `positions` of the front."""
        half_length = BODIES[self.target].length / 2
        return frame.along(positions) - self.direction.along * half_length, frame.left(
            positions
        ) - self.direction.left * half_length

    def next_speed(self, profile: SpeedProfile, sample: int, step: float) -> float:
        """Speed at the end of the coming step [m/s]."""
        return profile.speed_at((sample + 1) * step)

    def set_speed(self, world: World, speed: float) -> None:
        world.drive(TARGET, speed)
