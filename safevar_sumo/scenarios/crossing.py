"""Euro NCAP's pedestrians who cross the way, CPFA, CPNA and CPNCO."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import VUT, Actors, Grade, PreCrash, Roads, Scene, World
from safevar_sumo.scenarios.euro_ncap import BODIES, KMH, VUT_LENGTH, VUT_WIDTH, Range, Walk, beside, lateral_of
from safevar_sumo.scenarios.frame import SKEW, Frame

PEDESTRIAN = "pedestrian"
APPROACH, CROSSING, KERB = "approach_0", ":crossing_c0_0", "kerb_0"
WAYS = {"near": ("footpath", "footpath_on"), "far": ("footpath_on", "footpath")}
"""Edges that a pedestrian walks on, by the side that it comes from (of a road with right-hand traffic)."""
PARKED_GAP = 1.0
"""From the vehicle's side to the parked cars, from the nearer one's front to the child's path, and between the two [m]."""
PARKED_LENGTH = {"parked_small": 4.25, "parked_large": 4.5}
"""The middle of what the protocol allows, 4.1 to 4.4 and 4.3 to 4.7 m."""
PARKED_WIDTH = 1.8
WALKS_ON = 5.0
"""How far past the middle of the lane it walks before it stands [m]."""
Metres = Annotated[float, Meta(ge=0, le=100)]


class _Test(NamedTuple):
    """A row of the protocol's table: km/h, m, m, and the range of the tests."""

    side: str
    target: str
    target_speed: float
    lateral_start: float
    acceleration_distance: float
    hidden: bool
    range: Range


TESTS = {
    "CPFA": _Test("far", "adult", 8.0, 6.0, 1.5, False, Range(10, 60, (50, 10, 25, 75, 90))),
    "CPNA": _Test("near", "adult", 5.0, 4.0, 1.0, False, Range(10, 60, (25, 50, 75, 10, 90))),
    "CPNCO": _Test("near", "child", 5.0, 4.0, 1.0, True, Range(10, 60, (50, 10, 25, 75, 90))),
}


class _Memory(NamedTuple):
    """The lane, the path's place along it [m], where the pedestrian is due and was; step number; speed that it was last given."""

    frame: Frame
    path: float
    walk: Walk
    start: float
    place: FloatArray
    sample: int
    given: float


class Crossing(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A pedestrian crosses before a vehicle that is on its way, timed to be hit where it is meant to be if nobody brakes.

    Parameters
    ----------
    test
        Row of the protocol that gives what is not given here: CPFA, CPNA or CPNCO.
    speed
        The vehicle's at the start [km/h].
    impact_location
        Where on the vehicle's front the pedestrian would be hit, from the side that it comes from [% of the width].
    target, target_speed
        `adult` or `child`; its speed once it walks [km/h].
    side
        That it comes from: `near` or `far`.
    lateral_start, acceleration_distance
        From the middle of the lane to where it stands at first, and the way within which it reaches its speed [m].
    hidden
        Whether two parked cars stand between it and the vehicle.
    sensor_setback
        How far behind the front bumper, in its middle, the sensors look from [m].
    time_to_impact, time_after
        Time from the start to the impact, and on from there to the end of the run [s].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].

    Notes
    -----
    `lateral` is that of the pedestrian's middle, `gap` that of the side of its body that faces the vehicle.
    """

    test: Literal["CPFA", "CPNA", "CPNCO"] = "CPFA"
    speed: Annotated[float, Meta(gt=0, le=250)] = 40.0
    impact_location: Annotated[float, Meta(ge=0, le=100)] = 50.0
    target: Literal["adult", "child"] | None = None
    target_speed: Annotated[float, Meta(gt=0, le=18)] | None = None
    side: Literal["near", "far"] | None = None
    lateral_start: Annotated[float, Meta(gt=0, le=12)] | None = None
    acceleration_distance: Metres | None = None
    hidden: bool | None = None
    sensor_setback: Metres = 0.0
    time_to_impact: Annotated[float, Meta(gt=0, le=60)] = 6.0
    time_after: Annotated[float, Meta(gt=0, le=60)] = 4.0
    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0
    network: str = "crossing"
    reactive_actors = False
    pre_crash = PreCrash.PEDESTRIAN

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.time_to_impact + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].range.remarks(self.test, self.speed, self.impact_location, self.grade)

    def actors(self, roads: Roads) -> Actors:
        """The vehicle `time_to_impact` before the pedestrian's path, the pedestrian beside it, and the parked cars or none."""
        frame, walks_on = Frame.of(roads.lane(APPROACH)), WAYS[self._of("side")]
        path, _ = frame.place_of(roads.lane(CROSSING).start)
        for lane in (CROSSING, *(f"{edge}_0" for edge in walks_on)):
            enters, leaves = (frame.place_of(point)[0] for point in roads.lane(lane))
            if abs(leaves - enters) > SKEW:
                raise InputError("scenario.parameters.network", f"lane {lane!r} leads {abs(leaves - enters):.2f} m along the road",
                                 "a way across at right angles")
        body = BODIES[self._of("target")]
        front = path - body.width / 2 - self.speed * KMH * self.time_to_impact
        if front - self.vut_length < 0:
            raise InputError("scenario.parameters", f"{self.speed:g} km/h for {self.time_to_impact:g} s begin before the road does")
        self._walk()
        begins, ends = (self._sign * frame.place_of(point)[1] for point in roads.lane(f"{walks_on[0]}_0"))
        stands = body.length / 2 - self._of("lateral_start")
        if not min(begins, ends) <= stands <= max(begins, ends):
            nearest, farthest = body.length / 2 - max(begins, ends), body.length / 2 - min(begins, ends)
            raise InputError("scenario.parameters", f"lateral_start = {self._of('lateral_start'):g} m is not on the footpath",
                             f"a number in [{nearest:.2f}, {farthest:.2f}] m")
        changes = {
            "vType[@id='vut']": {"length": repr(self.vut_length), "width": repr(self.vut_width)},
            "vehicle[@id='vut']": {"departPos": repr(front), "departSpeed": repr(self.speed * KMH)},
            "person[@id='pedestrian']": {"type": self._of("target"), "departPos": repr(abs(stands - begins))},
            "person[@id='pedestrian']/walk": {
                "edges": " ".join(walks_on), "speed": repr(self._of("target_speed") * KMH), "arrivalPos": "-1" if self._sign > 0 else "1"},
        }
        return {**changes, **self._parked(frame, path, roads)}

    def _parked(self, frame: Frame, path: float, roads: Roads) -> Actors:
        """The parked cars beside the way, or none."""
        if not self._of("hidden"):
            return {f"vehicle[@id='{car}']": None for car in PARKED_LENGTH}
        start, left = frame.place_of(roads.lane(KERB).start)
        changes, end, across = dict[str, dict[str, str]](), path - PARKED_GAP - start, self._kerb_side - PARKED_WIDTH / 2 - left
        for car, length in PARKED_LENGTH.items():
            changes[f"vehicle[@id='{car}']"] = {"departPos": repr(end), "departPosLat": repr(across)}
            changes[f"vehicle[@id='{car}']/stop"] = {"endPos": repr(end)}
            end -= length + PARKED_GAP
        return changes

    def begin(self, world: World) -> _Memory:
        frame = Frame.of(world.lane(APPROACH))
        lateral = self._lateral(frame, world)
        world.walk(PEDESTRIAN, 0.0)
        path, _ = frame.place_of(world.lane(CROSSING).start)
        return _Memory(frame, path - BODIES[self._of("target")].width / 2, self._walk(), lateral[0], lateral, 0, 0.0)

    def observe(self, world: World, step: float, memory: _Memory) -> tuple[Scene, _Memory]:
        front = memory.frame.along(world.vehicle_positions(VUT))
        lateral = self._lateral(memory.frame, world)
        across = self._of("lateral_start") + WALKS_ON
        now, then = (min(memory.walk.travelled(sample * step), across) for sample in (memory.sample, memory.sample + 1))
        pace = (then - now) / step
        if pace != memory.given:
            world.walk(PEDESTRIAN, pace)
        lateral_speed = (lateral - memory.place) / step
        gap = memory.path - front
        body = BODIES[self._of("target")]
        left = (lateral > 0) & (beside(lateral, (self.vut_width + body.length) / 2) > 0)
        passed = gap < -body.width - self.vut_length
        scene = Scene(gap, lateral, lateral_speed, left | passed, visible=self._visible(gap, lateral))
        return scene, memory._replace(place=lateral, sample=memory.sample + 1, given=pace)

    def encounter(self, trace: Trace) -> Encounter:
        """Between the vehicle's front and the pedestrian's body, along the way and across it; TTC by how fast that shrinks."""
        body = BODIES[self._of("target")]
        ahead, across = np.maximum(trace.gap, 0.0), beside(trace.lateral, (self.vut_width + body.length) / 2)
        distance = np.sqrt(ahead * ahead + across * across)
        nearing = trace.speed * ahead - np.sign(trace.lateral) * trace.lateral_speed * across
        return Encounter(separation=distance, distance=distance, closing_speed=nearing / np.maximum(distance, 1e-9),
                         in_conflict=trace.gap > -body.width - self.vut_length)

    @property
    def _sign(self) -> float:
        """Of a `lateral` in metres to the left of the lane."""
        return 1.0 if self._of("side") == "near" else -1.0

    @property
    def _kerb_side(self) -> float:
        """Where the sides of parked cars are that face the lane, to its left [m]."""
        return -self.vut_width / 2 - PARKED_GAP

    def _of(self, name: str):  # type: ignore[no-untyped-def]
        """A parameter, or what the protocol has for it."""
        given = getattr(self, name)
        return getattr(TESTS[self.test], name) if given is None else given

    def _walk(self) -> Walk:
        way = self._of("lateral_start") + lateral_of(self.impact_location, self.vut_width)
        return Walk.reaching(way, self.time_to_impact, self._of("target_speed") * KMH, self._of("acceleration_distance"))

    def _lateral(self, frame: Frame, world: World) -> FloatArray:
        """Of the pedestrian's middle; SUMO tells the place of its front."""
        return self._sign * frame.left(world.person_positions(PEDESTRIAN)) - BODIES[self._of("target")].length / 2

    def _visible(self, gap: FloatArray, lateral: FloatArray) -> BoolArray:
        """Where the line from the sensors to the pedestrian's middle passes the front corner of the nearer parked car."""
        if not self._of("hidden"):
            return np.ones(gap.shape, dtype=bool)
        away = gap + BODIES[self._of("target")].width / 2 + self.sensor_setback
        corner = away - PARKED_GAP
        return np.asarray((corner <= 0) | (-lateral * corner < -self._kerb_side * away))
