"""What the scenarios of Euro NCAP's frontal crash avoidance tests share: targets, and somebody ahead (protocol CA-FC, v1.1, October 2025).

Speeds are in km/h and impact locations in per cent of the vehicle's width, as in the protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import VUT, Actors, Grade, Scene, World
from safevar_sumo.scenarios.frame import Frame

KMH = 1 / 3.6
"""m/s per km/h."""
VUT_LENGTH, VUT_WIDTH = 4.9016, 2.1284
"""The bounding box of CARLA's vehicle.lincoln.mkz2017 [m]."""


class Body(NamedTuple):
    """A pedestrian: length in the direction that it walks, width across [m]."""

    length: float
    width: float


BODIES = {"adult": Body(0.6, 0.5), "child": Body(0.711, 0.298)}


class Range(NamedTuple):
    """Range of a test of the protocol: lowest and highest speed [km/h], impact locations [%]."""

    slowest: float
    fastest: float
    locations: tuple[float, ...]

    def remarks(self, test: str, speed: float, location: float, grade: float) -> list[str]:
        """Remarks on what is outside the protocol's ranges or its level road."""
        remarks = []
        if not self.slowest <= speed <= self.fastest:
            remarks.append(f"{test}: speed = {speed:g} km/h is outside the protocol's {self.slowest:g} to {self.fastest:g} km/h")
        if location not in self.locations:
            legal = ", ".join(f"{location:g}" for location in self.locations)
            remarks.append(f"{test}: impact_location = {location:g} % is none of the protocol's {legal} %")
        if grade:
            remarks.append(f"{test}: grade = {grade:g} %, and the protocol's road is level")
        return remarks


class Walk(NamedTuple):
    """A target that stands, sets off at `begin` [s], reaches `speed` [m/s] with constant acceleration within `run_up` [m], and walks on."""

    begin: float
    speed: float
    run_up: float

    @classmethod
    def reaching(cls, way: float, time: float, speed: float, run_up: float) -> Walk:
        """The walk that covers `way` [m] until `time` [s]: way = speed t - run_up once the run-up is over."""
        if way < run_up:
            raise InputError("scenario.parameters", f"acceleration_distance = {run_up:g} m is longer than the way of {way:g} m")
        begin = time - (way + run_up) / speed
        if begin < 0:
            raise InputError("scenario.parameters", f"the target needs {(way + run_up) / speed:.2f} s to the impact and has {time:g} s",
                             "a faster target, a shorter way or a longer time_to_impact")
        return cls(begin, speed, run_up)

    def travelled(self, time: float) -> float:
        """Way covered [m] at a time [s]."""
        since = max(time - self.begin, 0.0)
        if not self.run_up or since >= 2 * self.run_up / self.speed:
            return self.speed * since - self.run_up
        return self.speed * self.speed / (4 * self.run_up) * since * since

    def pace(self, time: float) -> float:
        """Speed [m/s] at a time [s]."""
        since = max(time - self.begin, 0.0)
        if not self.run_up or since >= 2 * self.run_up / self.speed:
            return self.speed
        return self.speed * self.speed / (2 * self.run_up) * since


def lateral_of(location: float, width: float) -> float:
    """Offset of an impact location, 0 to 100 % of a vehicle's width from the left, from the middle of its front, to the right [m]."""
    return (location / 100 - 0.5) * width


def beside(distance: FloatArray, half_widths: float) -> FloatArray:
    """Gap between two bodies whose middles are `distance` apart; 0 where they overlap [m]."""
    return np.maximum(np.abs(distance) - half_widths, 0.0)


TARGET, ROAD = "target", "road_0"
START = 50.0
"""Place of the vehicle's front bumper on the lane at the start [m]."""
CLOSED_IN = 0.5
"""Closing speed [m/s] after which a vehicle that is no longer faster has avoided the target."""


class AheadMemory(NamedTuple):
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

    def begin(self, world: World) -> AheadMemory:
        nothing = np.zeros(len(world.vehicle_positions(VUT)))
        world.drive(TARGET, self.speed(0.0))
        return AheadMemory(Frame.of(world.lane(ROAD)), 0, self.speed(0.0), nothing > 0, nothing + self.offset)

    def observe(self, world: World, step: float, memory: AheadMemory, speed: FloatArray) -> tuple[Scene, AheadMemory]:
        """The scene at the vehicles' speed, shape (N,) [m/s]; gives the target its next speed."""
        frame, nothing = memory.frame, np.zeros_like(speed)
        gap = frame.along(world.vehicle_positions(TARGET)) - self.body.length - frame.along(world.vehicle_positions(VUT))
        now, then = self.speed(memory.sample * step), self.speed((memory.sample + 1) * step)
        if then != memory.given:
            world.drive(TARGET, then)
        closed_in = memory.closed_in | (speed - now > CLOSED_IN)
        scene = Scene(gap, memory.lateral, nothing, closed_in & (speed <= now), obstacle_speed=nothing + now)
        return scene, memory._replace(sample=memory.sample + 1, given=then, closed_in=closed_in)


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
    reactive_actors = False

    def begin(self, world: World) -> AheadMemory:
        return self._ahead.begin(world)

    def observe(self, world: World, step: float, memory: AheadMemory) -> tuple[Scene, AheadMemory]:
        return self._ahead.observe(world, step, memory, world.speeds())

    def encounter(self, trace: Trace) -> Encounter:
        """Distances from bumper to body; TTC is that gap over the difference of speeds."""
        return Encounter(separation=trace.gap, distance=trace.gap, closing_speed=trace.speed - trace.obstacle_speed,
                         in_conflict=trace.gap > 0)

    @property
    def _ahead(self) -> Ahead:
        raise NotImplementedError
