"""The common part of Euro NCAP's scenarios: a target that does not react to the vehicles under test.

Its motion is therefore computed once per recorded scene, at all samples, for thousands of vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import ALL_TRUE, BoolArray, FloatArray
from safevar_sumo.scenarios.base import VUT, Frame, Grade, PreCrash, Scenario, Scene, World, XmlChanges, as_text
from safevar_sumo.scenarios.euro_ncap import (
    KMH,
    TESTS,
    VUT_LENGTH,
    VUT_WIDTH,
    ImpactLocation,
    PersonMover,
    Seconds,
    Speed,
    VehicleMover,
)

APPROACH_SPEED = 0.5
"""Closing speed above which a vehicle approaches a target ahead [m/s]; once it is not faster, it has avoided it."""
PARKED_GAP = 1.0
"""Gap between vehicle and parked cars, between the nearer car's front and the target's path, and between the two cars
[m].
"""
Times = float | Sequence[float]
"""One time, or the times of all samples [s]."""
Quantity = FloatArray | float


class Target(NamedTuple):
    """Position and speed of a target: numbers, or arrays of shape (M,), of M copies at one time or at M samples.

    - `edge`: position along the lane of the side of the target's body that vehicles reach first [m]
    - `lateral`, `lateral_speed`: as in `Scene` [m, m/s]
    - `speed`: speed along the lane [m/s]
    - `is_clear`: true once the target has crossed the vehicle's path
    - `ahead`: distance along the lane from the point of impact to the body's middle [m]
    """

    edge: FloatArray
    lateral: FloatArray
    lateral_speed: Quantity = 0.0
    speed: Quantity = 0.0
    is_clear: BoolArray | bool = False
    ahead: Quantity = 0.0


class EncounterConstants(NamedTuple):
    """Quantities that are constant during a run: numbers, or arrays of shape (N,).

    A vehicle has passed the target when the gap is below `passed_gap` [m]. A vehicle that `follows` the target cannot
    pass: it has avoided the target once it has approached and is no longer faster. Parked cars hide a `hidden` target.
    Distances [m]: `edge_to_middle` of the target along the lane, `setback` from the sensors to the front bumper,
    `parked_offset` from the lane's middle to the parked cars.
    """

    passed_gap: Quantity = -np.inf
    follows: BoolArray | bool = False
    hidden: BoolArray | bool = False
    edge_to_middle: Quantity = 0.0
    setback: Quantity = 0.0
    parked_offset: Quantity = 0.0


class TargetMotion(NamedTuple):
    """The motion of a target in a run, relative to the vehicles' lane.

    Attributes
    ----------
    frame
        Frame of the vehicles' lane.
    constants
        The constants of the encounter with this target.
    mover
        How SUMO moves the target.
    target
        Returns the target with its front at positions, shape (M, 2) [m], at one time or at M times; without its lateral
        speed.
    """

    frame: Frame
    constants: EncounterConstants
    mover: PersonMover | VehicleMover
    target: Callable[[FloatArray, Times], Target]


class Memory(NamedTuple):
    """What the scenario remembers of a run.

    Attributes
    ----------
    motion
        The target's motion.
    last_lateral, last_speed
        The target's last lateral position [m], and the speed that it was last set to [m/s], one or shape (N,).
    sample
        Number of the current sample.
    approached
        Which vehicles have approached the target, shape (N,).
    """

    motion: TargetMotion
    last_lateral: FloatArray
    sample: int
    last_speed: Any
    approached: BoolArray


class TargetTest(Scenario, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the protocol's scenarios, with the parameters that all of them have.

    Parameters
    ----------
    test
        Row of the protocol, the source of parameters that are not set.
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the target [% of the width].
    time_after
        Time from the impact, if nobody brakes, to the end of the run [s].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].
    """

    test: str
    speed: Speed = 40.0
    impact_location: ImpactLocation = 50.0
    time_after: Seconds = 4.0
    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0
    network: str = ""
    reactive_actors = False

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's pre-crash type."""
        return TESTS[self.test].pre_crash

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    def parameter(self, name: str) -> Any:
        """A parameter as the study sets it, by default as the protocol does."""
        value = getattr(self, name, None)
        return getattr(TESTS[self.test], name) if value is None else value

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol's ranges and on a road that is not level."""
        row, remarks = TESTS[self.test], []
        if not row.slowest <= self.speed <= row.fastest:
            tested = f"{row.slowest:g} to {row.fastest:g} km/h"
            remarks.append(f"speed = {self.speed:g} km/h is outside the protocol's {tested}")
        if self.impact_location not in row.locations:
            tested = ", ".join(f"{location:g}" for location in row.locations)
            remarks.append(f"impact_location = {self.impact_location:g} % is none of the protocol's {tested} %")
        if self.grade:
            remarks.append(f"grade = {self.grade:g} %, and the protocol's road is level")
        return [f"{self.test}: {remark}" for remark in remarks]

    def _vehicle_at(self, front: float) -> XmlChanges:
        """The vehicle under test with its front at a position on its lane [m], at its speed."""
        if front - self.vut_length < 0:
            raise InputError("scenario.parameters", "the way to the target is longer than the road", "a shorter time")
        return {
            "vType[@id='vut']": {"length": repr(self.vut_length), "width": repr(self.vut_width)},
            "vehicle[@id='vut']": {"departPos": as_text(front), "departSpeed": as_text(self.test_speed)},
        }

    def begin(self, world: World) -> Memory:
        motion = self._motion(world)
        motion.mover.set_speed(world, motion.mover.initial_speed)
        lateral = motion.target(motion.mover.positions(world), 0.0).lateral
        return Memory(motion, lateral, 0, motion.mover.initial_speed, np.zeros(len(lateral), dtype=bool))

    def observe(self, world: World, step: float, memory: Memory) -> tuple[Scene, Memory]:
        motion = memory.motion
        target = motion.target(motion.mover.positions(world), memory.sample * step)
        target = target._replace(lateral_speed=(target.lateral - memory.last_lateral) / step)
        front = motion.frame.along(world.vehicle_positions(VUT))
        scene, approached = scene_of(motion.constants, target, front, world.speeds(), memory.approached)
        return scene, self.move(world, step, memory)._replace(last_lateral=target.lateral, approached=approached)

    def move(self, world: World, step: float, memory: Memory) -> Memory:
        """Set the target's next speed, as `observe` does, without computing the scene."""
        mover = memory.motion.mover
        speed = mover.next_speed(memory.sample, step)
        if np.any(speed != memory.last_speed):
            mover.set_speed(world, speed)
        return memory._replace(sample=memory.sample + 1, last_speed=speed)

    def at_all_samples(self, world: World, step: float) -> tuple[TargetMotion, Target, BoolArray]:
        """The target's motion in a recorded scene; the target at each of T samples, and whether it is not on the road.

        The T copies of `world` are the samples. A target that has left the road stays where it was last.
        """
        motion = self._motion(world)
        positions = motion.mover.positions(world)
        samples = np.arange(len(positions))
        is_absent = np.isnan(positions[:, 0])
        last_present = np.maximum.accumulate(np.where(is_absent, 0, samples))
        target = motion.target(positions[last_present], [sample * step for sample in samples.tolist()])
        last_lateral = np.concatenate([target.lateral[:1], target.lateral[:-1]])
        return motion, target._replace(lateral_speed=(target.lateral - last_lateral) / step), is_absent

    def _motion(self, world: World) -> TargetMotion:
        raise NotImplementedError


def scene_of(
    constants: EncounterConstants, target: Target, front: FloatArray, speed: FloatArray, approached: BoolArray
) -> tuple[Scene, BoolArray]:
    """The scene of N vehicles, and which of them have approached; `front` is where their fronts are on the lane [m]."""
    gap, zeros = target.edge - front, np.zeros_like(front)  # a number plus zeros has shape (N,)
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
    # The line is `-lateral * to_corner / to_middle` from the lane's middle where it passes the car's corner.
    is_free = (to_corner <= 0) | (-target.lateral * to_corner < constants.parked_offset * to_middle)
    return ~np.asarray(constants.hidden) | is_free


def value_at(times: Times, function: Callable[[float], float]) -> Quantity:
    """A function's value at one time, or an array of its values at all times."""
    return np.array([function(time) for time in times]) if isinstance(times, Sequence) else function(times)
