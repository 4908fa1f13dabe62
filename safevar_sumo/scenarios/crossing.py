"""Euro NCAP's tests with a crossing target: pedestrians, cyclists, and a car or a motorcyclist at a junction."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from msgspec.structs import force_setattr

from safevar_sumo.errors import InputError
from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import PEDESTRIAN, Frame, Layout, PreCrash, Roads, World, XmlChanges, driven_distance
from safevar_sumo.scenarios.euro_ncap import (
    BODIES,
    FROM_LEFT,
    FROM_RIGHT,
    JUNCTION,
    KMH,
    STOP_DISTANCE,
    TARGET,
    TESTS,
    BodySize,
    Direction,
    Heading,
    Metres,
    PersonMover,
    Seconds,
    SpeedProfile,
    VehicleMover,
    approach,
    lateral_offset,
)
from safevar_sumo.scenarios.target import (
    PARKED_GAP,
    EncounterConstants,
    Target,
    TargetMotion,
    TargetTest,
    Times,
    value_at,
)

FOOTPATH_NETWORK = "crossing"
KERB_LANE = "kerb_0"
PARKED_LENGTH = {"parked_small": 4.25, "parked_large": 4.5}
"""Lengths of the parked cars [m]: the middle of the protocol's ranges, 4.1 to 4.4 and 4.3 to 4.7 m."""
PARKED_WIDTH = 1.8
TIME_TO_IMPACT = 6.0
"""Time from the start to the impact, unless the target needs longer [s]."""
FASTEST_PERSON = 25 * KMH
"""Speed of a fast runner [m/s]; SUMO moves persons above some 34 km/h in other steps than the recorded scene has."""
LEAST_DISTANCE = 1e-9
"""Lower bound of a distance that is a divisor [m]."""
ROUNDING_STEP = 0.5
"""A time to impact above `TIME_TO_IMPACT` is rounded up to a multiple of this step [s]."""
PRE_CRASH = {TESTS[test].target: TESTS[test].pre_crash for test in ("CPFA", "CPNCO", "CBNA", "CCCscp", "CMCscp")}
"""Pre-crash types by target."""


class _Start(NamedTuple):
    """How a test starts.

    Attributes
    ----------
    mover, direction, extent
        How SUMO moves the target, the direction of motion, and the size of the target's body along the lane and across
        it [m].
    impact_left
        Distance of the impact to the left of the lane's middle [m].
    distance_to_impact, time_to_impact
        Distance and time from the target's start to the impact [m, s].
    profile
        The target's speed over time.
    """

    mover: PersonMover | VehicleMover
    direction: Direction
    extent: BodySize
    impact_left: Any
    distance_to_impact: Any
    time_to_impact: Any
    profile: SpeedProfile

    @classmethod
    def of(cls, test: Crossing) -> _Start:
        """The start of a test.

        Raises
        ------
        InputError
            If the target cannot reach the impact location in time.
        """
        target, lateral_start = test.parameter("target"), test.parameter("lateral_start")
        speed = test.parameter("target_speed") * KMH
        if test.is_on_foot and np.max(speed) > FASTEST_PERSON:
            problem = f"target_speed = {np.max(speed) / KMH:g} km/h of a person on foot"
            raise InputError("scenario.parameters", problem, f"at most {FASTEST_PERSON / KMH:g} km/h")
        sign = 1.0 if test.parameter("side") == "near" else -1.0  # 1 for a target that moves to the left
        impact_lateral = lateral_offset(test.impact_location, test.vut_width)
        direction = (FROM_RIGHT if sign > 0 else FROM_LEFT).turned(test.heading)
        if lateral_start is None:
            if test.acceleration_distance is not None:
                raise InputError(
                    "scenario.parameters", "acceleration_distance: the target starts at its speed", "lateral_start too"
                )
            time = float(test.time_to_impact or TIME_TO_IMPACT) * test.start_share
            distance, profile = speed * time, SpeedProfile(begin=0.0, speed=speed, run_up=0.0)
        else:
            distance = (lateral_start + impact_lateral) * test.start_share
            run_up = test.parameter("acceleration_distance")
            shortest_time = (distance + run_up) / speed
            time = test.time_to_impact or np.maximum(
                TIME_TO_IMPACT, np.ceil(shortest_time / ROUNDING_STEP) * ROUNDING_STEP
            )
            profile = SpeedProfile.with_arrival(distance, time - test.lead, speed, run_up)
        mover = (
            PersonMover(target, sign, -lateral_start, profile, test.stop)
            if test.is_on_foot
            else VehicleMover(target, direction, profile.speed_at)
        )
        return cls(mover, direction, direction.extent(BODIES[target]), sign * impact_lateral, distance, time, profile)


class Crossing(TargetTest, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A target crosses the lane ahead of the moving vehicle, and is hit at the impact location if nobody brakes.

    Parameters
    ----------
    test
        Row of the protocol, the source of parameters that are not set here: CPFA, CPNA, CPNCO (pedestrians), CBFA,
        CBNA, CBNAO (cyclists), CCCscp or CMCscp (a car or a motorcyclist at a junction).
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the target's middle, from the side where the target starts [% of the
        width]; below 0 or above 100 the target's middle passes behind or ahead of the vehicle's corner.
    target, target_speed
        `adult`, `child`, `cyclist`, `motorcyclist` or `car`; its speed once it moves [km/h].
    side
        Side where the target starts: `near` or `far`.
    lateral_start, acceleration_distance
        Distance of the standing target from the middle of the lane, and distance within which it reaches its speed [m].
        Without a `lateral_start` cyclists, motorcyclists and cars start at their speed.
    start_share
        Share of the usual distance to the impact at which the target starts [-].
    heading
        Rotation of the target's path around the point of impact, counterclockwise seen from above [degrees].
    hidden
        Whether two parked cars stand between target and vehicle.
    sensor_setback
        Distance of the sensors behind the middle of the front bumper [m].
    time_to_impact, time_after
        Time from the start to the impact, by default 6 s or as long as the target needs, and from there to the end of
        the run [s].
    vut_length, vut_width
        Size of the vehicle under test [m].
    grade
        Rise of the road over its length, negative downhill [%].
    network
        By default `crossing` for a pedestrian who crosses at right angles from the usual start, `junction` for all
        other targets.

    Notes
    -----
    `lateral` refers to the target's middle, `gap` to the corner or side of its body that is nearest along the lane.

    Where the protocol leaves a choice, this class follows Euro NCAP's calculator (euroncap-rating-2026 5.4.9).
    `target_speed`, `start_share` and `heading` express its robustness layers. Assumptions where the calculator leaves a
    choice too:

    - With every layer the target still arrives at the impact location.
    - A faster target starts from the usual position; if it starts at its speed, from correspondingly farther away.
    - With a smaller `start_share` a standing target sets off later, and the run of a moving target begins with the
      target nearer.
    - At a junction the middle of the target meets the middle of the front. The target comes from the near side; the
      calculator chooses a side at random.
    """

    test: Literal["CPFA", "CPNA", "CPNCO", "CBNA", "CBFA", "CBNAO", "CCCscp", "CMCscp"] = "CPFA"
    target: Literal["adult", "child", "cyclist", "motorcyclist", "car"] | None = None
    target_speed: Annotated[float, Meta(gt=0, le=150)] | None = None
    side: Literal["near", "far"] | None = None
    lateral_start: Annotated[float, Meta(gt=0, le=12)] | None = None
    acceleration_distance: Metres | None = None
    start_share: Annotated[float, Meta(gt=0, le=1)] = 1.0
    heading: Heading = 0.0
    hidden: bool | None = None
    sensor_setback: Metres = 0.0
    time_to_impact: Seconds | None = None

    def __post_init__(self) -> None:
        if not self.network:
            force_setattr(self, "network", FOOTPATH_NETWORK if self.is_on_foot else JUNCTION)

    @property
    def stop(self) -> float:
        """Position at which a pedestrian stops, past the middle of the lane [m]."""
        return STOP_DISTANCE

    @property
    def lead(self) -> float:
        """Time by which a pedestrian is at the place of the impact before the vehicle [s]."""
        return 0.0

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's pre-crash type."""
        return PRE_CRASH[self.parameter("target")]

    def obstacle(self) -> str:
        """The target, and where it comes from."""
        target = self.parameter("target")
        start = "behind a parked car" if self.parameter("hidden") else f"the {self.parameter('side')} side"
        return f"{'an' if target == 'adult' else 'a'} {target} from {start}"

    @property
    def duration(self) -> Any:
        """Length of a run [s]."""
        return _Start.of(self).time_to_impact + self.time_after

    def lanes(self, roads: Roads) -> XmlChanges:
        """Changes to the target's lanes: their direction."""
        return _Start.of(self).mover.lanes(approach(roads), roads)

    def actors(self, roads: Roads) -> XmlChanges:
        """The vehicle before the target's path, the target beside the vehicle's lane, and the parked cars, if any."""
        frame, start = approach(roads), _Start.of(self)
        impact_position = start.mover.impact_position(frame, roads, start.impact_left)
        return {
            **self._vehicle_at(self._front(start, impact_position)),
            **start.mover.actors(frame, roads, start.impact_left, start.distance_to_impact),
            **self._parked_cars(frame, impact_position, roads),
        }

    def _front(self, start: _Start, impact_position: Any) -> Any:
        """Position of the vehicle's front on its lane at the start [m]."""
        return impact_position - start.extent.length / 2 - self.test_speed * start.time_to_impact

    def layout(self, roads: Roads, step: float, samples: int) -> Layout:
        frame, start, times = approach(roads), _Start.of(self), np.arange(samples)[:, np.newaxis] * step
        impact_position = start.mover.impact_position(frame, roads, start.impact_left)
        front = self._front(start, impact_position)
        if isinstance(start.mover, PersonMover):
            path, speeds = start.mover.path(times, step)
            return Layout(frame, front, self.test_speed, PEDESTRIAN, None, start.mover.sign * path, speeds)
        speeds = start.profile.speed_at(times)
        path = driven_distance(speeds, step) - start.distance_to_impact + BODIES[start.mover.target].length / 2
        along, left = (
            place + component * path
            for place, component in zip((impact_position, start.impact_left), start.direction, strict=True)
        )
        return Layout(frame, front, self.test_speed, TARGET, along, left, speeds)

    def _parked_cars(self, frame: Frame, impact_position: float, roads: Roads) -> XmlChanges:
        """The parked cars beside the lane, if any."""
        if not self.parameter("hidden"):
            return {f"vehicle[@id='{car}']": None for car in PARKED_LENGTH}
        kerb_start, kerb_left = frame.lane_coordinates(roads.lane(KERB_LANE).start)
        changes, offset = {}, self._parked_edge - PARKED_WIDTH / 2 - kerb_left
        front = impact_position - PARKED_GAP - kerb_start  # of the car nearer to the target's path
        for car, length in PARKED_LENGTH.items():
            changes[f"vehicle[@id='{car}']"] = {"departPos": repr(front), "departPosLat": repr(offset)}
            changes[f"vehicle[@id='{car}']/stop"] = {"endPos": repr(front)}
            front -= length + PARKED_GAP
        return changes

    def _motion(self, world: World) -> TargetMotion:
        frame, start = approach(world), _Start.of(self)
        constants = EncounterConstants(
            passed_gap=-start.extent.length - self.vut_length,
            hidden=self.parameter("hidden"),
            edge_to_middle=start.extent.length / 2,
            setback=self.sensor_setback,
            parked_offset=-self._parked_edge,
        )
        direction, extent, profile = start.direction, start.extent, start.profile
        impact_position = start.mover.impact_position(frame, world, start.impact_left)

        def target(positions: FloatArray, times: Times) -> Target:
            along, left = start.mover.middle(frame, positions)
            lateral = left if direction.left > 0 else -left
            ahead = np.zeros_like(left) if along is None else along - impact_position
            is_clear = lateral > (self.vut_width + extent.width) / 2
            speed = value_at(times, lambda time: direction.along * profile.speed_at(time)) if direction.along else 0.0
            edge = impact_position - extent.length / 2 + ahead
            return Target(edge, lateral, is_clear=is_clear, speed=speed, ahead=ahead)

        return TargetMotion(frame, constants, start.mover, target)

    def encounter(self, trace: Trace) -> Encounter:
        """Distance between the vehicle's front and the target's body, along and across the lane; TTC from its rate of
        change.
        """
        extent = _Start.of(self).extent
        ahead = np.maximum(trace.gap, 0.0)
        across = np.maximum(np.abs(trace.lateral) - (self.vut_width + extent.width) / 2, 0.0)
        distance = np.sqrt(ahead * ahead + across * across)
        approach = (trace.speed - trace.obstacle_speed) * ahead - np.sign(trace.lateral) * trace.lateral_speed * across
        return Encounter(
            separation=distance,
            distance=distance,
            closing_speed=approach / np.maximum(distance, LEAST_DISTANCE),
            in_conflict=trace.gap > -extent.length - self.vut_length,
        )

    @property
    def is_on_foot(self) -> bool:
        """Whether the target is a person in SUMO: a pedestrian who crosses at right angles from a footpath."""
        return (
            self.parameter("target") in ("adult", "child")
            and self.parameter("lateral_start") is not None
            and self.heading == 0
            and self.start_share == 1
        )

    @property
    def _parked_edge(self) -> float:
        """Lateral position of the parked cars' sides that face the lane, to the left of its middle [m]."""
        return -self.vut_width / 2 - PARKED_GAP
