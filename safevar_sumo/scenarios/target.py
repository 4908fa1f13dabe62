"""A target that does not react to the vehicles under test: the common part of Euro NCAP's scenarios.

As the target's motion does not depend on the vehicles, it is computed once per recorded scene, at all samples, for thousands of
vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import Struct

from safevar_sumo.records import ALL_TRUE, BoolArray, FloatArray
from safevar_sumo.scenarios.base import VUT, Scene, World
from safevar_sumo.scenarios.frame import Frame

APPROACH_SPEED = 0.5
"""Closing speed above which a vehicle approaches a target ahead [m/s]; if it is later no longer faster, it has avoided the target."""
PARKED_GAP = 1.0
"""Gap between vehicle and parked cars, between the nearer car's front and the target's path, and between the two cars [m]."""
Times = float | Sequence[float]
"""One time, or the times of all samples [s]."""


class Target(NamedTuple):
    """Position and speed of a target: numbers, or arrays of shape (M,), of M copies at one time or of M samples.

    `edge` is the position along the lane of the side of the target's body that vehicles reach first, `ahead` the distance of the body's
    middle beyond the point of impact [m]; `speed` is along the lane [m/s]; `has_left` is true once the target has left the vehicle's path.
    """

    edge: FloatArray
    lateral: FloatArray
    lateral_speed: Any = 0.0
    speed: Any = 0.0
    has_left: Any = False
    ahead: Any = 0.0


class EncounterConstants(NamedTuple):
    """Quantities that are constant during a run: numbers, or arrays of shape (N,).

    A vehicle has passed the target when the gap is below `passed_gap` [m]. A vehicle that `follows` the target cannot pass: it has avoided
    the target once it has approached and is no longer faster. Parked cars hide a `hidden` target. Distances [m]: `to_middle` from the
    target's edge to its middle, `setback` from the sensors to the front bumper, `parked_offset` from the lane's middle to the parked cars.
    """

    passed_gap: Any = -np.inf
    follows: Any = False
    hidden: Any = False
    to_middle: Any = 0.0
    setback: Any = 0.0
    parked_offset: Any = 0.0


class TargetMotion(Protocol):
    """The motion of a target in a run, relative to the vehicles' lane."""

    @property
    def frame(self) -> Frame:
        """Frame of the vehicles' lane."""

    @property
    def constants(self) -> EncounterConstants:
        """The constants of the encounter with this target."""

    def begin(self, world: World) -> float:
        """Set the target's initial speed; returns this speed [m/s]."""

    def positions(self, world: World) -> FloatArray:
        """Positions of the target's front in SUMO; shape (N, 2) [m]."""

    def target(self, positions: FloatArray, times: Times) -> Target:
        """The target with its front at `positions`, shape (M, 2) [m], at one time or at M times; without its lateral speed."""

    def next_speed(self, sample: int, step: float) -> float:
        """The target's speed in the step after a sample [m/s]."""

    def set_speed(self, world: World, speed: float) -> None:
        """Set the target's speed [m/s]."""


class Memory(NamedTuple):
    """The target's motion, last lateral position [m], and speed set last [m/s]; the number of samples; which vehicles have approached."""

    motion: TargetMotion
    lateral: FloatArray
    sample: int
    speed: float
    approached: BoolArray


class TargetTest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario whose target does not react."""

    reactive_actors = False

    def begin(self, world: World) -> Memory:
        motion = self._motion(world)
        speed = motion.begin(world)
        lateral = motion.target(motion.positions(world), 0.0).lateral
        return Memory(motion, lateral, 0, speed, np.zeros(len(lateral), dtype=bool))

    def observe(self, world: World, step: float, memory: Memory) -> tuple[Scene, Memory]:
        motion = memory.motion
        target = motion.target(motion.positions(world), memory.sample * step)
        target = target._replace(lateral_speed=(target.lateral - memory.lateral) / step)
        front = motion.frame.along(world.vehicle_positions(VUT))
        scene, approached = scene_of(motion.constants, target, front, world.speeds(), memory.approached)
        return scene, self.move(world, step, memory)._replace(lateral=target.lateral, approached=approached)

    def move(self, world: World, step: float, memory: Memory) -> Memory:
        """Set the target's next speed, as `observe` does, without computing the scene."""
        speed = memory.motion.next_speed(memory.sample, step)
        if speed != memory.speed:
            memory.motion.set_speed(world, speed)
        return memory._replace(sample=memory.sample + 1, speed=speed)

    def at_all_samples(self, world: World, samples: World, step: float) -> tuple[TargetMotion, Target]:
        """The target's motion in a recorded scene, and the target at its T samples, which the world `samples` holds as T copies."""
        motion = self._motion(world)
        positions = motion.positions(samples)
        target = motion.target(positions, [sample * step for sample in range(len(positions))])
        previous = np.concatenate([target.lateral[:1], target.lateral[:-1]])
        return motion, target._replace(lateral_speed=(target.lateral - previous) / step)

    def _motion(self, world: World) -> TargetMotion:
        raise NotImplementedError


def scene_of(constants: EncounterConstants, target: Target, front: FloatArray, speed: FloatArray,
             approached: BoolArray) -> tuple[Scene, BoolArray]:
    """The scene of N vehicles by the position of their fronts along the lane [m] and their speed [m/s], and which have approached."""
    gap, zeros = target.edge - front, np.zeros_like(front)
    over = np.asarray(target.has_left | (gap < constants.passed_gap))
    if constants.follows is not False:
        approached = approached | (speed - target.speed > APPROACH_SPEED)
        over = over | constants.follows & approached & (speed <= target.speed)
    visible = ALL_TRUE if constants.hidden is False else _visible(constants, target, gap)
    return Scene(gap, zeros + target.lateral, zeros + target.lateral_speed, over, zeros + target.speed, visible), approached


def _visible(constants: EncounterConstants, target: Target, gap: FloatArray) -> BoolArray:
    """Whether the line from the sensors to the target's middle clears the front corner of the nearer parked car; shape (N,)."""
    distance = gap + constants.to_middle + constants.setback
    corner = distance - target.ahead - PARKED_GAP
    return np.asarray(~np.asarray(constants.hidden) | (corner <= 0) | (-target.lateral * corner < constants.parked_offset * distance))


def value_at(times: Times, function: Callable[[float], float]) -> Any:
    """A function's value at one time, or an array of its values at all times."""
    return np.array([function(time) for time in times]) if isinstance(times, Sequence) else function(times)
