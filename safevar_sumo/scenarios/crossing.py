"""Euro NCAP's targets that cross the way: pedestrians, cyclists, and a car or a motorcyclist at a junction."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from msgspec.structs import force_setattr

from safevar_sumo.errors import InputError
from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import Actors, Grade, PreCrash, Roads, World
from safevar_sumo.scenarios.crossing_target import NETWORK_ON_FOOT, OnFoot, OnWheels
from safevar_sumo.scenarios.euro_ncap import (
    APPROACH,
    BODIES,
    FROM_LEFT,
    FROM_RIGHT,
    JUNCTION,
    KMH,
    VUT_LENGTH,
    VUT_WIDTH,
    Body,
    Direction,
    Heading,
    ImpactLocation,
    Range,
    Walk,
    gap_beside,
    lateral_of,
)
from safevar_sumo.scenarios.frame import Frame
from safevar_sumo.scenarios.target import PARKED_GAP, Course, Target, TargetTest, Times, at

KERB = "kerb_0"
PARKED_LENGTH = {"parked_small": 4.25, "parked_large": 4.5}
"""The middle of what the protocol allows, 4.1 to 4.4 and 4.3 to 4.7 m."""
PARKED_WIDTH = 1.8
TIME_TO_IMPACT = 6.0
"""Time from the start to the impact, unless the target needs longer [s]."""
ROUNDED_TO = 0.5
"""A longer time is a multiple of this [s]."""
Metres = Annotated[float, Meta(ge=0, le=100)]
LOCATIONS = (50.0, 25.0, 75.0, 10.0, 90.0)


class _Test(NamedTuple):
    """A row of the protocol's table: km/h, m, m, and the range of the tests; who has no `lateral_start` is as fast from the start on."""

    side: str
    target: str
    target_speed: float
    lateral_start: float | None
    acceleration_distance: float
    hidden: bool
    range: Range


TESTS = {
    "CPFA": _Test("far", "adult", 8.0, 6.0, 1.5, False, Range(10, 60, LOCATIONS)),
    "CPNA": _Test("near", "adult", 5.0, 4.0, 1.0, False, Range(10, 60, LOCATIONS)),
    "CPNCO": _Test("near", "child", 5.0, 4.0, 1.0, True, Range(10, 60, LOCATIONS)),
    "CBNA": _Test("near", "cyclist", 15.0, None, 0.0, False, Range(10, 60, LOCATIONS)),
    "CBFA": _Test("far", "cyclist", 20.0, None, 0.0, False, Range(10, 60, LOCATIONS)),
    "CBNAO": _Test("near", "cyclist", 10.0, None, 0.0, True, Range(10, 60, LOCATIONS)),
    "CCCscp": _Test("near", "car", 40.0, None, 0.0, False, Range(20, 80, (50.0,))),
    "CMCscp": _Test("near", "motorcyclist", 40.0, None, 0.0, False, Range(20, 80, (50.0,))),
}
PRE_CRASH = {"adult": PreCrash.PEDESTRIAN, "child": PreCrash.PEDESTRIAN, "cyclist": PreCrash.CYCLIST,
             "motorcyclist": PreCrash.STRAIGHT_PATHS, "car": PreCrash.STRAIGHT_PATHS}


class _Meeting(NamedTuple):
    """A vehicle before a target's path at a place along the lane [m]: its walk, how it moves, what it takes up; see `Meeting`."""

    frame: Frame
    course: Course
    path: float
    walk: Walk
    mover: OnFoot | OnWheels
    reach: Body
    direction: Direction
    vut_width: float

    def begin(self, world: World) -> float:
        return self.mover.begin(world, self.walk)

    def positions(self, world: World) -> FloatArray:
        return self.mover.positions(world)

    def target(self, positions: FloatArray, times: Times) -> Target:
        along, left = self.mover.middle(self.frame, positions)
        lateral = left if self.direction.left > 0 else -left
        ahead = np.zeros_like(left) if along is None else along - self.path
        forth = self.direction.along
        return Target(self.path - self.reach.length / 2 + ahead, lateral, gone=lateral > (self.vut_width + self.reach.width) / 2,
                      speed=at(times, lambda time: forth * self.walk.pace(time)) if forth else 0.0, ahead=ahead)

    def pace(self, sample: int, step: float) -> float:
        return self.mover.pace(self.walk, sample, step)

    def go(self, world: World, pace: float) -> None:
        self.mover.go(world, pace)


class Crossing(TargetTest, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Somebody crosses before a vehicle that is on its way, timed to be hit where it is meant to be if nobody brakes.

    Parameters
    ----------
    test
        Row of the protocol that gives what is not given here: CPFA, CPNA, CPNCO (pedestrians), CBFA, CBNA, CBNAO (cyclists), CCCscp or
        CMCscp (a car or a motorcyclist at a junction).
    speed
        The vehicle's at the start [km/h].
    impact_location
        Where on the vehicle's front the target's middle would be hit, from the side that it comes from [% of the width]; below 0 or
        above 100 it passes behind or before the vehicle's corner.
    target, target_speed
        `adult`, `child`, `cyclist`, `motorcyclist` or `car`; its speed once it moves [km/h].
    side
        That it comes from: `near` or `far`.
    lateral_start, acceleration_distance
        From the middle of the lane to where it stands at first, and the way within which it reaches its speed [m]. Cyclists, motorcyclists
        and cars are as fast from the start on, unless this says where they stand.
    start_share
        Share of its usual distance to the impact at which it starts [-].
    heading
        Turn of its way around the point of the impact, counterclockwise seen from above [degrees].
    hidden
        Whether two parked cars stand between it and the vehicle.
    sensor_setback
        How far behind the front bumper, in its middle, the sensors look from [m].
    time_to_impact, time_after
        Time from the start to the impact, by default 6 s or as long as the target needs, and on from there to the end of the run [s].
    vut_length, vut_width
        The vehicle under test [m].
    grade
        By how much the road rises over the way, negative where it falls [%].
    network
        By default `crossing` for a pedestrian who crosses at right angles from the usual start, `junction` for everybody else.

    Notes
    -----
    `lateral` is that of the target's middle, `gap` that of the corner or side of its body that is nearest along the way.

    Where the protocol leaves a choice this is Euro NCAP's calculator's (euroncap-rating-2026 5.4.9): conditions of its robustness
    layers by `target_speed`, `start_share` and `heading`. What it leaves open is chosen: whatever a layer changes, the target still
    arrives at the impact location; a faster one starts from where the usual one stands, or is as far away as its speed takes it. With a
    smaller `start_share` one who stands sets off later, and the run of one who does not begins when it is there. At a junction the
    middle of the target meets the middle of the front, and it comes from the near side, of which the calculator says one at random.
    """

    test: Literal["CPFA", "CPNA", "CPNCO", "CBNA", "CBFA", "CBNAO", "CCCscp", "CMCscp"] = "CPFA"
    speed: Annotated[float, Meta(gt=0, le=250)] = 40.0
    impact_location: ImpactLocation = 50.0
    target: Literal["adult", "child", "cyclist", "motorcyclist", "car"] | None = None
    target_speed: Annotated[float, Meta(gt=0, le=150)] | None = None
    side: Literal["near", "far"] | None = None
    lateral_start: Annotated[float, Meta(gt=0, le=12)] | None = None
    acceleration_distance: Metres | None = None
    start_share: Annotated[float, Meta(gt=0, le=1)] = 1.0
    heading: Heading = 0.0
    hidden: bool | None = None
    sensor_setback: Metres = 0.0
    time_to_impact: Annotated[float, Meta(gt=0, le=60)] | None = None
    time_after: Annotated[float, Meta(gt=0, le=60)] = 4.0
    vut_length: Annotated[float, Meta(gt=0.5, le=30)] = VUT_LENGTH
    vut_width: Annotated[float, Meta(gt=0.5, le=3.5)] = VUT_WIDTH
    grade: Grade = 0.0
    network: str = ""

    def __post_init__(self) -> None:
        if not self.network:
            force_setattr(self, "network", NETWORK_ON_FOOT if self._on_foot else JUNCTION)

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's type."""
        return PRE_CRASH[self._of("target")]

    @property
    def test_speed(self) -> float:
        """Speed that the vehicle holds until it brakes [m/s]."""
        return self.speed * KMH

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self._time + self.time_after

    def remarks(self) -> list[str]:
        """Remarks on parameters outside the protocol."""
        return TESTS[self.test].range.remarks(self.test, self.speed, self.impact_location, self.grade)

    def lanes(self, roads: Roads) -> Actors:
        """The direction of the lane across."""
        return self._mover.lanes(Frame.of(roads.lane(APPROACH)), roads)

    def actors(self, roads: Roads) -> Actors:
        """The vehicle before the target's path, the target beside it, and the parked cars or none."""
        frame, mover, walk = Frame.of(roads.lane(APPROACH)), self._mover, self._walk
        path = mover.path(frame, roads, self._sideways)
        front = path - self._reach.length / 2 - self.speed * KMH * self._time
        if front - self.vut_length < 0:
            raise InputError("scenario.parameters", f"{self.speed:g} km/h for {self._time:g} s begin before the road does")
        changes = {
            "vType[@id='vut']": {"length": repr(self.vut_length), "width": repr(self.vut_width)},
            "vehicle[@id='vut']": {"departPos": repr(front), "departSpeed": repr(self.speed * KMH)},
            **mover.actors(frame, roads, self._sideways, self._way, walk),
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

    def _meeting(self, world: World) -> _Meeting:
        frame, mover, reach = Frame.of(world.lane(APPROACH)), self._mover, self._reach
        course = Course(past=-reach.length - self.vut_length)
        if self._of("hidden"):
            course = course._replace(hidden=True, to_middle=reach.length / 2, setback=self.sensor_setback, kerb=-self._kerb_side)
        return _Meeting(frame, course, mover.path(frame, world, self._sideways), self._walk, mover, reach, self._direction, self.vut_width)

    def encounter(self, trace: Trace) -> Encounter:
        """Between the vehicle's front and the target's body, along the way and across it; TTC by how fast that shrinks."""
        ahead, across = np.maximum(trace.gap, 0.0), gap_beside(trace.lateral, (self.vut_width + self._reach.width) / 2)
        distance = np.sqrt(ahead * ahead + across * across)
        nearing = (trace.speed - trace.obstacle_speed) * ahead - np.sign(trace.lateral) * trace.lateral_speed * across
        return Encounter(separation=distance, distance=distance, closing_speed=nearing / np.maximum(distance, 1e-9),
                         in_conflict=trace.gap > -self._reach.length - self.vut_length)

    @property
    def _on_foot(self) -> bool:
        """Whether it is a pedestrian who crosses at right angles from where footpaths are, a person to SUMO."""
        return self._of("target") in ("adult", "child") and self.heading == 0 and self.start_share == 1

    @property
    def _mover(self) -> OnFoot | OnWheels:
        target = self._of("target")
        if self._on_foot:
            return OnFoot(target, self._sign, -self._of("lateral_start"))
        return OnWheels(target, self._direction)

    @property
    def _direction(self) -> Direction:
        return (FROM_RIGHT if self._of("side") == "near" else FROM_LEFT).turned(self.heading)

    @property
    def _reach(self) -> Body:
        """What its body takes up along the way and across it [m]."""
        return self._direction.reach(BODIES[self._of("target")])

    @property
    def _sign(self) -> float:
        """Of a `lateral` in metres to the left of the lane."""
        return 1.0 if self._of("side") == "near" else -1.0

    @property
    def _location(self) -> float:
        """The `lateral` of the impact location [m]."""
        return lateral_of(self.impact_location, self.vut_width)

    @property
    def _sideways(self) -> float:
        """How far to the left of the lane's middle the impact is [m]."""
        return self._sign * self._location

    @property
    def _kerb_side(self) -> float:
        """Where the sides of parked cars are that face the lane, to its left [m]."""
        return -self.vut_width / 2 - PARKED_GAP

    @property
    def _way(self) -> float:
        """From where it starts to the impact [m]."""
        if self._starts_at_speed:
            return self._target_speed * self._time
        return (self._of("lateral_start") + self._location) * self.start_share  # type: ignore[no-any-return]

    @property
    def _time(self) -> float:
        """From the start to the impact [s]."""
        if self._starts_at_speed:
            return float(self.time_to_impact or TIME_TO_IMPACT) * self.start_share
        if self.time_to_impact is not None:
            return self.time_to_impact
        needed = (self._way + self._of("acceleration_distance")) / self._target_speed
        return float(max(TIME_TO_IMPACT, math.ceil(needed / ROUNDED_TO) * ROUNDED_TO))

    @property
    def _walk(self) -> Walk:
        if self._starts_at_speed:
            if self.acceleration_distance is not None:
                raise InputError("scenario.parameters", "acceleration_distance: the target does not stand first", "lateral_start too")
            return Walk(0.0, self._target_speed, 0.0)
        return Walk.reaching(self._way, self._time, self._target_speed, self._of("acceleration_distance"))

    @property
    def _starts_at_speed(self) -> bool:
        """Whether it does not stand first."""
        return self._of("lateral_start") is None

    @property
    def _target_speed(self) -> float:
        """Once it moves [m/s]."""
        return self._of("target_speed") * KMH  # type: ignore[no-any-return]

    def _of(self, name: str) -> Any:
        """A parameter, or what the protocol has for it."""
        given = getattr(self, name)
        return getattr(TESTS[self.test], name) if given is None else given
