"""How SUMO moves who crosses: a pedestrian at right angles as a person on a footpath, everybody else as a vehicle on a lane of its own."""

from __future__ import annotations

from typing import NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.base import Actors, Roads, World
from safevar_sumo.scenarios.euro_ncap import ACROSS, BODIES, FROM_RIGHT, INSIDE, TARGET, Direction, Walk, lanes_across, target_type
from safevar_sumo.scenarios.frame import SKEW, Frame

NETWORK_ON_FOOT = "crossing"
PEDESTRIAN = "pedestrian"
CROSSING = ":crossing_c0_0"
WAYS = {1.0: ("footpath", "footpath_on"), -1.0: ("footpath_on", "footpath")}
"""Edges that a pedestrian walks on, by the sign of a `lateral` in metres to the left (of a road with right-hand traffic)."""
WALKS_ON = 5.0
"""How far past the middle of the lane a pedestrian walks before it stands [m]."""


class OnFoot(NamedTuple):
    """A pedestrian who starts at a `lateral` [m] and walks to the left of the lane, or to its right where the sign is negative."""

    target: str
    sign: float
    start: float

    def lanes(self, frame: Frame, roads: Roads) -> Actors:
        """It walks where the network has it."""
        return {}

    def path(self, frame: Frame, roads: Roads | World, sideways: float) -> float:
        """Where along the lane its middle is when it is that far to the left [m]."""
        return frame.place_of(roads.lane(CROSSING).start)[0]

    def actors(self, frame: Frame, roads: Roads, sideways: float, way: float, walk: Walk) -> Actors:
        """The pedestrian beside the lane, `way` before the impact [m]."""
        edges = WAYS[self.sign]
        for lane in (CROSSING, *(f"{edge}_0" for edge in edges)):
            enters, leaves = (frame.place_of(point)[0] for point in roads.lane(lane))
            if abs(leaves - enters) > SKEW:
                raise InputError("scenario.parameters.network", f"lane {lane!r} leads {abs(leaves - enters):.2f} m along the road",
                                 "a way across at right angles")
        ahead = BODIES[self.target].length / 2
        begins, ends = (self.sign * frame.place_of(point)[1] for point in roads.lane(f"{edges[0]}_0"))
        stands = ahead + self.start
        if not min(begins, ends) <= stands <= max(begins, ends):
            nearest, farthest = ahead - max(begins, ends), ahead - min(begins, ends)
            raise InputError("scenario.parameters", f"lateral_start = {-self.start:g} m is not on the footpath",
                             f"a number in [{nearest:.2f}, {farthest:.2f}] m")
        return {
            "person[@id='pedestrian']": {"type": self.target, "departPos": repr(abs(stands - begins))},
            "person[@id='pedestrian']/walk": {
                "edges": " ".join(edges), "speed": repr(walk.speed), "arrivalPos": "-1" if self.sign > 0 else "1"},
        }

    def begin(self, world: World, walk: Walk) -> float:
        """Have it stand; returns its speed [m/s]."""
        world.walk(PEDESTRIAN, 0.0)
        return 0.0

    def positions(self, world: World) -> FloatArray:
        """Where SUMO has its front; shape (N, 2) [m]."""
        return world.person_positions(PEDESTRIAN)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Where its middle is along the lane, None where its path leads, and to its left [m], with its front at these positions."""
        return None, frame.left(positions) - self.sign * BODIES[self.target].length / 2

    def pace(self, walk: Walk, sample: int, step: float) -> float:
        """Mean speed in the coming step [m/s]."""
        across = WALKS_ON - self.start
        now, then = (min(walk.travelled(one * step), across) for one in (sample, sample + 1))
        return (then - now) / step

    def go(self, world: World, pace: float) -> None:
        world.walk(PEDESTRIAN, pace)


class OnWheels(NamedTuple):
    """A target on the junction's lane across, which leads in its direction."""

    target: str
    direction: Direction

    def lanes(self, frame: Frame, roads: Roads) -> Actors:
        """Its lanes, turned around where they cross the vehicle's; none where they are as the network has them."""
        if self.direction == FROM_RIGHT:
            return {}
        (along, before), (_, after) = (frame.place_of(point) for point in roads.lane(INSIDE))
        (forth, left), half = self.direction, (after - before) / 2
        return lanes_across(frame, (along - half * forth, -half * left), (along + half * forth, half * left), self.direction)

    def path(self, frame: Frame, roads: Roads | World, sideways: float) -> float:
        """Where along the lane its middle is when it is that far to the left [m]."""
        along, left = frame.place_of(roads.lane(ACROSS).end)
        return along + (sideways - left) * self.direction.along / self.direction.left

    def actors(self, frame: Frame, roads: Roads, sideways: float, way: float, walk: Walk) -> Actors:
        """The target on its lane, `way` before the impact [m]."""
        lane, (forth, left) = roads.lane(ACROSS), self.direction
        place = self._place(frame, lane.start)
        front = (self.path(frame, roads, sideways) * forth + sideways * left) - place - way + BODIES[self.target].length / 2
        length = self._place(frame, lane.end) - place
        if not 0 < front <= length:
            raise InputError("scenario.parameters", f"the target starts {way:.2f} m before the impact, where it has no lane",
                             f"a start from {way - (length - front):.2f} to {way + front:.2f} m before it")
        return {
            "vType[@id='target']": target_type(self.target),
            "vehicle[@id='target']": {"type": self.target, "departPos": repr(front), "departSpeed": repr(walk.pace(0.0))},
        }

    def _place(self, frame: Frame, point: tuple[float, float]) -> float:
        """How far in its direction a point is [m]."""
        along, left = frame.place_of(point)
        return along * self.direction.along + left * self.direction.left

    def begin(self, world: World, walk: Walk) -> float:
        """Have it move as at the start; returns its speed [m/s]."""
        world.drive(TARGET, walk.pace(0.0))
        return walk.pace(0.0)

    def positions(self, world: World) -> FloatArray:
        """Where SUMO has its front; shape (N, 2) [m]."""
        return world.vehicle_positions(TARGET)

    def middle(self, frame: Frame, positions: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Where its middle is along the lane and to its left [m], with its front at these positions."""
        behind = BODIES[self.target].length / 2
        return frame.along(positions) - self.direction.along * behind, frame.left(positions) - self.direction.left * behind

    def pace(self, walk: Walk, sample: int, step: float) -> float:
        """Speed at the end of the coming step [m/s]."""
        return walk.pace((sample + 1) * step)

    def go(self, world: World, pace: float) -> None:
        world.drive(TARGET, pace)
