"""A target that does not react to the vehicles under test: the common part of Euro NCAP's scenarios.

As the target's motion does not depend on the vehicles, it is computed once per recorded scene, at all samples, for
thousands of vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import Struct

from safevar_sumo.records import ALL_TRUE, BoolArray, FloatArray
from safevar_sumo.scenarios.base import VUT, Scenario, Scene, World
from safevar_sumo.scenarios.frame import Frame

APPROACH_SPEED = 0.5
"""Closing speed above which a vehicle approaches a target ahead [m/s]; if it is later no longer faster, it has avoided
the target.
"""
PARKED_GAP = 1.0
"""Gap between vehicle and parked cars, between the nearer car's front and the target's path, and between the two cars
[m].
"""
Times = float | Sequence[float]
"""One time, or the times of all samples [s]."""


class Target(NamedTuple):
    """Position and speed of a target: numbers, or arrays of shape (M,), either of M copies at one time or of one target
    at M samples.

    - `edge`: position along the lane of the side of the target's body that vehicles reach first [m]
    - `lateral`, `lateral_speed`: as in `Scene` [m, m/s]
    - `speed`: speed along the lane [m/s]
    - `is_clear`: true once the target has crossed the vehicle's path
    - `ahead`: distance along the lane from the point of impact to the body's middle [m]
    """

    edge: FloatArray
    lateral: FloatArray
    lateral_speed: Any = 0.0
    speed: Any = 0.0
    is_clear: Any = False
    ahead: Any = 0.0


class EncounterConstants(NamedTuple):
    """Quantities that are constant during a run: numbers, or arrays of shape (N,).

    A vehicle has passed the target when the gap is below `passed_gap` [m]. A vehicle that `follows` the target cannot
    pass: it has avoided the target once it has approached and is no longer faster. Parked cars hide a `hidden` target.
    Distances [m]: `edge_to_middle` of the target along the lane, `setback` from the sensors to the front bumper,
    `parked_offset` from the lane's middle to the parked cars.
    """

    passed_gap: Any = -np.inf
    follows: Any = False
    hidden: Any = False
    edge_to_middle: Any = 0.0
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
        """The target with its front at `positions`, shape (M, 2) [m], at one time or at M times; without its lateral
        speed.
        """

    def next_speed(self, sample: int, step: float) -> float:
        """The target's speed in the step after a sample [m/s]."""

    def set_speed(self, world: World, speed: float) -> None:
        """Set the target's speed [m/s]."""


class Memory(NamedTuple):
    """The target's motion, last lateral position [m], and speed set last [m/s]; the number of samples; which vehicles
    have approached.
    """

    motion: TargetMotion
    last_lateral: FloatArray
    sample: int
    last_speed: float
    approached: BoolArray


class TargetTest(Scenario, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario whose target does not react."""

    reactive_actors = False

    def begin(self, world: World) -> Memory:
        motion = self._motion(world)
        initial_speed = motion.begin(world)
        lateral = motion.target(motion.positions(world), 0.0).lateral
        return Memory(
            motion, lateral, sample=0, last_speed=initial_speed, approached=np.zeros(len(lateral), dtype=bool)
        )

    def observe(self, world: World, step: float, memory: Memory) -> tuple[Scene, Memory]:
        motion = memory.motion
        target = motion.target(motion.positions(world), memory.sample * step)
        target = target._replace(lateral_speed=(target.lateral - memory.last_lateral) / step)
        front = motion.frame.along(world.vehicle_positions(VUT))
        scene, approached = scene_of(motion.constants, target, front, world.speeds(), memory.approached)
        return scene, self.move(world, step, memory)._replace(last_lateral=target.lateral, approached=approached)

    def move(self, world: World, step: float, memory: Memory) -> Memory:
        """Set the target's next speed, as `observe` does, without computing the scene."""
        speed = memory.motion.next_speed(memory.sample, step)
        if speed != memory.last_speed:
            memory.motion.set_speed(world, speed)
        return memory._replace(sample=memory.sample + 1, last_speed=speed)

    def at_all_samples(self, world: World, sampled_world: World, step: float) -> tuple[TargetMotion, Target]:
        """The target's motion in a recorded scene, and the target at its T samples, which are the T copies of
        `sampled_world`.
        """
        motion = self._motion(world)
        positions = motion.positions(sampled_world)
        target = motion.target(positions, [sample * step for sample in range(len(positions))])
        last_lateral = np.concatenate([target.lateral[:1], target.lateral[:-1]])
        return motion, target._replace(lateral_speed=(target.lateral - last_lateral) / step)

    def _motion(self, world: World) -> TargetMotion:
        raise NotImplementedError


def scene_of(
    constants: EncounterConstants, target: Target, front: FloatArray, speed: FloatArray, approached: BoolArray
) -> tuple[Scene, BoolArray]:
    """The scene of N vehicles, and which of them have approached; `front` is their fronts' position along the lane
    [m].
    """
    gap, zeros = target.edge - front, np.zeros_like(front)
    over = np.asarray(target.is_clear | (gap < constants.passed_gap))
    if constants.follows is not False:
        approached = approached | (speed - target.speed > APPROACH_SPEED)
        over = over | (constants.follows & approached & (speed <= target.speed))
    visible = ALL_TRUE if constants.hidden is False else _visible(constants, target, gap)
    return Scene(
        gap, zeros + target.lateral, zeros + target.lateral_speed, over, zeros + target.speed, visible
    ), approached


def _visible(constants: EncounterConstants, target: Target, gap: FloatArray) -> BoolArray:
    """Whether the parked car nearer to the target leaves the line from the sensors to the target's middle free; shape
    (N,).
    """
    to_middle = gap + constants.edge_to_middle + constants.setback
    to_corner = to_middle - target.ahead - PARKED_GAP
    is_free = (to_corner <= 0) | (-target.lateral * to_corner < constants.parked_offset * to_middle)
    return np.asarray(~np.asarray(constants.hidden) | is_free)


def value_at(times: Times, function: Callable[[float], float]) -> Any:
    """A function's value at one time, or an array of its values at all times."""
    return np.array([function(time) for time in times]) if isinstance(times, Sequence) else function(times)
