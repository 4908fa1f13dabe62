"""How SUMO moves a crossing target: a pedestrian who crosses at right angles is a person on a footpath, any other a vehicle on its lane."""

from __future__ import annotations

from typing import NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.base import Roads, World, XmlChanges
from safevar_sumo.scenarios.euro_ncap import ACROSS, BODIES, FROM_RIGHT, INSIDE, TARGET, Direction, Walk, lanes_across, target_type
from safevar_sumo.scenarios.frame import SKEW, Frame

NETWORK_ON_FOOT = "crossing"
PEDESTRIAN = "pedestrian"
CROSSING = ":crossing_c0_0"
WAYS = {1.0: ("footpath", "footpath_on"), -1.0: ("footpath_on", "footpath")}
"""Edges that a pedestrian walks on, in this order: 1.0 walks to the left of the vehicle, -1.0 to the right."""
WALKS_ON = 5.0
"""Distance past the middle of the lane at which a pedestrian stops [m]."""


class OnFoot(NamedTuple):
    """A pedestrian who walks to the left of the lane (`sign` 1) or to its right (-1), from `start` before the middle of the lane [m]."""

    target: str
    sign: float
    start: float

    def lanes(self, frame: Frame, roads: Roads) -> XmlChanges:
        """No changes: the network's footpath serves as it is."""
        return {}

    def path(self, frame: Frame, roads: Roads | World, sideways: float) -> float:
        """Position of its middle along the lane when `sideways` metres to the left of the lane [m]."""
        return frame.place_of(roads.lane(CROSSING).start)[0]

    def actors(self, frame: Frame, roads: Roads, sideways: float, distance: float, walk: Walk) -> XmlChanges:
        """The pedestrian beside the lane, `distance` metres before the impact."""
        edges = WAYS[self.sign]
        for lane in (CROSSING, *(f"{edge}_0" for edge in edges)):
            enters, leaves = (frame.place_of(point)[0] for point in roads.lane(lane))
            if abs(leaves - enters) > SKEW:
                raise InputError("scenario.parameters.network", f"lane {lane!r} leads {abs(leaves - enters):.2f} m along the road",
                                 "a crossing at right angles")
        half_length = BODIES[self.target].length / 2
        edge_start, edge_end = (self.sign * frame.place_of(point)[1] for point in roads.lane(f"{edges[0]}_0"))
        standing_at = half_length + self.start
        if not min(edge_start, edge_end) <= standing_at <= max(edge_start, edge_end):
            nearest, farthest = half_length - max(edge_start, edge_end), half_length - min(edge_start, edge_end)
            raise InputError("scenario.parameters", f"lateral_start = {-self.start:g} m is not on the footpath",
                             f"a number in [{nearest:.2f}, {farthest:.2f}] m")
        return {
            "person[@id='pedestrian']": {"type": self.target, "departPos": repr(abs(standing_at - edge_start))},
            "person[@id='pedestrian']/walk": {
                "edges": " ".join(edges), "speed": repr(walk.speed), "arrivalPos": "-1" if self.sign > 0 else "1"},
        }

    def begin(self, world: World, walk: Walk) -> float:
        """Make the pedestrian stand; returns the speed [m/s]."""
        world.walk(PEDESTRIAN, 0.0)
        return 0.0

    def positions(self, world: World) -> FloatArray:
        """Position of its front in SUMO; shape (N, 2) [m]."""
        return world.person_positions(PEDESTRIAN)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Position of its middle along the lane (None: as `path` returns it) and to the left [m]; `positions` are those of its front."""
        return None, frame.left(positions) - self.sign * BODIES[self.target].length / 2

    def next_speed(self, walk: Walk, sample: int, step: float) -> float:
        """Mean speed in the coming step [m/s]."""
        walking_distance = WALKS_ON - self.start
        now, then = (min(walk.travelled(k * step), walking_distance) for k in (sample, sample + 1))
        return (then - now) / step

    def set_speed(self, world: World, speed: float) -> None:
        world.walk(PEDESTRIAN, speed)


class OnWheels(NamedTuple):
    """A target on the crossing lane of the junction, which leads in the target's direction."""

    target: str
    direction: Direction

    def lanes(self, frame: Frame, roads: Roads) -> XmlChanges:
        """Its lanes, rotated around the point where they cross the vehicle's lane; none for a target from the right, as in the network."""
        if self.direction == FROM_RIGHT:
            return {}
        (along, before), (_, after) = (frame.place_of(point) for point in roads.lane(INSIDE))
        (forward, left), half = self.direction, (after - before) / 2
        return lanes_across(frame, (along - half * forward, -half * left), (along + half * forward, half * left), self.direction)

    def path(self, frame: Frame, roads: Roads | World, sideways: float) -> float:
        """Position of its middle along the lane when `sideways` metres to the left of the lane [m]."""
        along, left = frame.place_of(roads.lane(ACROSS).end)
        return along + (sideways - left) * self.direction.along / self.direction.left

    def actors(self, frame: Frame, roads: Roads, sideways: float, distance: float, walk: Walk) -> XmlChanges:
        """The target on its lane, `distance` metres before the impact."""
        lane, (forward, left) = roads.lane(ACROSS), self.direction
        start = self._along(frame, lane.start)
        front = (self.path(frame, roads, sideways) * forward + sideways * left) - start - distance + BODIES[self.target].length / 2
        length = self._along(frame, lane.end) - start
        if not 0 < front <= length:
            raise InputError("scenario.parameters", f"the target starts {distance:.2f} m before the impact, where it has no lane",
                             f"a start from {distance - (length - front):.2f} to {distance + front:.2f} m before it")
        return {
            "vType[@id='target']": target_type(self.target),
            "vehicle[@id='target']": {"type": self.target, "departPos": repr(front), "departSpeed": repr(walk.speed_at(0.0))},
        }

    def _along(self, frame: Frame, point: tuple[float, float]) -> float:
        """Position of a point along the target's direction [m]."""
        along, left = frame.place_of(point)
        return along * self.direction.along + left * self.direction.left

    def begin(self, world: World, walk: Walk) -> float:
        """Set the speed of the start; returns it [m/s]."""
        world.drive(TARGET, walk.speed_at(0.0))
        return walk.speed_at(0.0)

    def positions(self, world: World) -> FloatArray:
        """Position of its front in SUMO; shape (N, 2) [m]."""
        return world.vehicle_positions(TARGET)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Position of its middle along the lane and to the left [m]; `positions` are those of its front."""
        behind = BODIES[self.target].length / 2
        return frame.along(positions) - self.direction.along * behind, frame.left(positions) - self.direction.left * behind

    def next_speed(self, walk: Walk, sample: int, step: float) -> float:
        """Speed at the end of the coming step [m/s]."""
        return walk.speed_at((sample + 1) * step)

    def set_speed(self, world: World, speed: float) -> None:
        world.drive(TARGET, speed)
