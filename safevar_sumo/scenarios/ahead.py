"""Somebody ahead in the lane: what the scenarios along the way have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import VUT, Actors, Grade, Scene, World
from safevar_sumo.scenarios.euro_ncap import VUT_LENGTH, VUT_WIDTH, Body, lateral_of
from safevar_sumo.scenarios.frame import Frame

TARGET, ROAD = "target", "road_0"
START = 50.0
"""Place of the vehicle's front bumper on the lane at the start [m]."""
CLOSED_IN = 0.5
"""Whoever has closed in by so much and does so no longer has been avoided [m/s]."""


class Memory(NamedTuple):
    """The lane; step number; speed that the target was last given [m/s]; whether the vehicle has closed in; lateral offset [m]."""

    frame: Frame
    sample: int
    given: float
    closed_in: BoolArray
    lateral: FloatArray


class Ahead(NamedTuple):
    """A target of a body at a gap [m] and lateral offset [m, to the right], with a speed over time [m/s at s]."""

    body: Body
    gap: float
    offset: float
    speed: Callable[[float], float]

    def actors(self, kind: str, vut: Body, speed: float) -> Actors:
        """The vehicle at `speed` [m/s], and the target, of the traffic's type `kind`, in front of it."""
        if self.gap <= 0:
            raise InputError("scenario.parameters", f"the target begins {-self.gap:.2f} m inside the vehicle", "a target ahead")
        return {
            "vType[@id='vut']": {"length": repr(vut.length), "width": repr(vut.width)},
            "vehicle[@id='vut']": {"departPos": repr(START), "departSpeed": repr(speed)},
            "vehicle[@id='target']": {
                "type": kind, "departPos": repr(START + self.gap + self.body.length), "departPosLat": repr(-self.offset),
                "departSpeed": repr(self.speed(0.0))},
        }

    def begin(self, world: World) -> Memory:
        nothing = np.zeros(len(world.vehicle_positions(VUT)))
        world.drive(TARGET, self.speed(0.0))
        return Memory(Frame.of(world.lane(ROAD)), 0, self.speed(0.0), nothing > 0, nothing + self.offset)

    def observe(self, world: World, step: float, memory: Memory, speed: FloatArray) -> tuple[Scene, Memory]:
        """With the vehicle's speed, shape (N,) [m/s]."""
        frame, nothing = memory.frame, np.zeros_like(speed)
        gap = frame.along(world.vehicle_positions(TARGET)) - self.body.length - frame.along(world.vehicle_positions(VUT))
        now, then = self.speed(memory.sample * step), self.speed((memory.sample + 1) * step)
        if then != memory.given:
            world.drive(TARGET, then)
        closed_in = memory.closed_in | (speed - now > CLOSED_IN)
        scene = Scene(gap, memory.lateral, nothing, closed_in & (speed <= now), obstacle_speed=nothing + now)
        return scene, memory._replace(sample=memory.sample + 1, given=then, closed_in=closed_in)


def right_of(location: float, width: float) -> float:
    """Offset to the right of a target that is hit at an impact location, 0 % at the vehicle's left corner [m]."""
    return lateral_of(location, width)


class BehindSomebody(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario with somebody ahead.

    Parameters
    ----------
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].
    """

    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0

    def begin(self, world: World) -> Memory:
        return self._ahead.begin(world)

    def observe(self, world: World, step: float, memory: Memory) -> tuple[Scene, Memory]:
        return self._ahead.observe(world, step, memory, world.speeds())

    def encounter(self, trace: Trace) -> Encounter:
        """From bumper to body; TTC is that gap over by how much the vehicle is faster."""
        return Encounter(separation=trace.gap, distance=trace.gap, closing_speed=trace.speed - trace.obstacle_speed,
                         in_conflict=trace.gap > 0)

    @property
    def _ahead(self) -> Ahead:
        raise NotImplementedError
