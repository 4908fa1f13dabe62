"""A target that nobody changes, and vehicles that meet it: what Euro NCAP's scenarios have in common.

Where the target is and where the vehicles are is worked out apart, so that a recorded scene has its target once, at all samples, for
vehicles by the thousand and in as many scenes as share a road.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import Struct

from safevar_sumo.records import EVERYWHERE, BoolArray, FloatArray
from safevar_sumo.scenarios.base import VUT, Scene, World
from safevar_sumo.scenarios.frame import Frame

CLOSED_IN = 0.5
"""Closing speed [m/s] after which a vehicle that is no longer faster has avoided a target ahead."""
PARKED_GAP = 1.0
"""From the vehicle's side to the parked cars, from the nearer one's front to the target's path, and between the two [m]."""
Times = float | Sequence[float]
"""One time, or those of all samples [s]."""


class Target(NamedTuple):
    """Where a target is and how fast: numbers, or arrays of shape (M,), of M copies at one time or of M samples.

    `edge` is the place along the lane of the side of its body that vehicles reach first, `ahead` that of its middle beyond the point of
    the impact [m]; `speed` is the one along the lane [m/s]; it is `gone` once it has left the vehicle's way.
    """

    edge: FloatArray
    lateral: FloatArray
    lateral_speed: Any = 0.0
    speed: Any = 0.0
    gone: Any = False
    ahead: Any = 0.0


class Course(NamedTuple):
    """What stays as it is in a run: numbers, or arrays of shape (N,).

    A vehicle is past the target below a gap [m]. One that cannot pass has avoided it once it has closed in and is no longer faster.
    Parked cars hide a `hidden` target: `to_middle` is from its edge to its middle, `setback` from the sensors to the front bumper, `kerb`
    from the middle of the lane to the cars' sides [m].
    """

    past: Any = -np.inf
    follows: Any = False
    hidden: Any = False
    to_middle: Any = 0.0
    setback: Any = 0.0
    kerb: Any = 0.0


class Meeting(Protocol):
    """A target's motion in a run."""

    @property
    def frame(self) -> Frame:
        """Of the lane that vehicles are on."""

    @property
    def course(self) -> Course:
        """What stays as it is."""

    def begin(self, world: World) -> float:
        """Have the target move as at the start; returns its speed [m/s]."""

    def positions(self, world: World) -> FloatArray:
        """Front of the target; shape (N, 2) [m]."""

    def target(self, positions: FloatArray, times: Times) -> Target:
        """The target with its front at these positions, shape (M, 2) [m], at one time or at M; its lateral speed is left out."""

    def pace(self, sample: int, step: float) -> float:
        """The target's speed in the step after a sample [m/s]."""

    def go(self, world: World, pace: float) -> None:
        """Have the target move at a speed [m/s]."""


class Memory(NamedTuple):
    """The meeting; where the target was; step number; speed that it was last given [m/s]; which vehicles have closed in."""

    meeting: Meeting
    lateral: FloatArray
    sample: int
    given: float
    closed_in: BoolArray


class TargetTest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a scenario whose target nobody changes."""

    reactive_actors = False

    def begin(self, world: World) -> Memory:
        meeting = self._meeting(world)
        given = meeting.begin(world)
        lateral = meeting.target(meeting.positions(world), 0.0).lateral
        return Memory(meeting, lateral, 0, given, np.zeros(len(lateral), dtype=bool))

    def observe(self, world: World, step: float, memory: Memory) -> tuple[Scene, Memory]:
        meeting = memory.meeting
        target = meeting.target(meeting.positions(world), memory.sample * step)
        target = target._replace(lateral_speed=(target.lateral - memory.lateral) / step)
        front = meeting.frame.along(world.vehicle_positions(VUT))
        scene, closed_in = scene_of(meeting.course, target, front, world.speeds(), memory.closed_in)
        return scene, self.move(world, step, memory)._replace(lateral=target.lateral, closed_in=closed_in)

    def move(self, world: World, step: float, memory: Memory) -> Memory:
        """Have the target move on, as `observe` does, without a look at the scene."""
        pace = memory.meeting.pace(memory.sample, step)
        if pace != memory.given:
            memory.meeting.go(world, pace)
        return memory._replace(sample=memory.sample + 1, given=pace)

    def at_all_samples(self, world: World, samples: World, step: float) -> tuple[Meeting, Target]:
        """The meeting in a recorded scene, and its target at all samples; the scene as `samples` has its T samples for N copies."""
        meeting = self._meeting(world)
        positions = meeting.positions(samples)
        target = meeting.target(positions, [sample * step for sample in range(len(positions))])
        before = np.concatenate([target.lateral[:1], target.lateral[:-1]])
        return meeting, target._replace(lateral_speed=(target.lateral - before) / step)

    def _meeting(self, world: World) -> Meeting:
        raise NotImplementedError


def scene_of(course: Course, target: Target, front: FloatArray, speed: FloatArray, closed_in: BoolArray) -> tuple[Scene, BoolArray]:
    """The scene of vehicles by their front's place along the lane [m] and their speed [m/s], and which have closed in; shape (N,)."""
    gap, nothing = target.edge - front, np.zeros_like(front)
    over = np.asarray(target.gone | (gap < course.past))
    if course.follows is not False:
        closed_in = closed_in | (speed - target.speed > CLOSED_IN)
        over = over | course.follows & closed_in & (speed <= target.speed)
    visible = EVERYWHERE if course.hidden is False else _visible(course, target, gap)
    return Scene(gap, nothing + target.lateral, nothing + target.lateral_speed, over, nothing + target.speed, visible), closed_in


def _visible(course: Course, target: Target, gap: FloatArray) -> BoolArray:
    """Where the line from the sensors to the target's middle passes the front corner of the nearer parked car."""
    away = gap + course.to_middle + course.setback
    corner = away - target.ahead - PARKED_GAP
    return np.asarray(~np.asarray(course.hidden) | (corner <= 0) | (-target.lateral * corner < course.kerb * away))


def at(times: Times, of: Callable[[float], float]) -> Any:
    """A number at one time, or an array at those of all samples."""
    return np.array([of(time) for time in times]) if isinstance(times, Sequence) else of(times)
