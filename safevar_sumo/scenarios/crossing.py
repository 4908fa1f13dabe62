"""Euro NCAP's tests with a crossing target: pedestrians, cyclists, and a car or a motorcyclist at a
junction.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from msgspec.structs import replace

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Quantity
from safevar_sumo.scenarios.ahead import HEADWAYS, next_lane
from safevar_sumo.scenarios.base import PreCrash, Scenario
from safevar_sumo.scenarios.euro_ncap import (
    FROM_LEFT,
    FROM_RIGHT,
    TESTS,
    Direction,
    Heading,
    ImpactLocation,
    Metres,
    ProtocolTest,
    Seconds,
    TargetProfile,
    lateral_offset,
)
from safevar_sumo.scenarios.tracks import (
    BODIES,
    KMH,
    PERSONS,
    SCREEN,
    Speed,
    Track,
)
from safevar_sumo.study import PositiveProportion, searched

PARKED_GAP = 1.0
"""Three gaps with the same value [m]: between the side of the vehicle and the parked cars; between
the target's path and the front of the parked car that is nearer to it; between both parked cars.
"""
PARKED_LENGTHS = {"parked_small": 4.25, "parked_large": 4.5}
"""Lengths of the two parked cars [m]. The small car is nearer to the target. The lengths are the
middles of the protocol's ranges: 4.1 to 4.4 m and 4.3 to 4.7 m.
"""
PARKED_WIDTH = 1.8
"""Width of the two parked cars [m]."""
ROW_LENGTH = 1000.0
"""Length of a body that stands for a row of parked cars [m]. The body only hides what is behind it:
the vehicle can hit the two parked cars, but not see past the row.
"""
TIME_TO_IMPACT = 6.0
"""Time from the start of the run to the impact, unless the target needs a longer time [s]."""
ROUNDING_STEP = 0.5
"""A time to impact above `TIME_TO_IMPACT` is rounded up to a multiple of this step [s]."""
STOP_DISTANCE = 5.0
"""Distance between the middle of the lane and the place at which a pedestrian stops after crossing
[m].
"""
SHORT_OF_PATH = (0.3, 0.6, 1.0, 1.5, 2.0)
"""Distances before the vehicle's path at which the pedestrian of a benign scene stops [m]."""
LEADS = (1.5, 2.0)
"""Times by which the pedestrian of a benign scene reaches the place of the impact before the
vehicle [s]. The pedestrian has left the vehicle's path half a second after reaching this place.
"""
PRE_CRASH = {
    TESTS[test].target: TESTS[test].pre_crash
    for test in ("CPFA", "CPNCO", "CBNA", "CCCscp", "CMCscp")
}
"""NHTSA's pre-crash type of each kind of target."""


class _Start(NamedTuple):
    """How the target starts, and where it meets the vehicle if nobody brakes. Quantities are
    numbers, or arrays of shape (N,) for N encounters.

    Attributes
    ----------
    direction
        The direction in which the target moves.
    extent
        Extent of the target's body along the lane [m].
    impact_left
        Distance of the impact to the left of the lane's middle [m].
    distance_to_impact
        Distance that the target covers from its start to the impact [m].
    time_to_impact
        Time from the start of the run to the impact [s].
    profile
        The target's speed over time.
    """

    direction: Direction
    extent: float
    impact_left: Quantity
    distance_to_impact: Quantity
    time_to_impact: Quantity
    profile: TargetProfile

    @classmethod
    def of(cls, test: Crossing) -> _Start:
        """Compute how the target of a test starts.

        Raises
        ------
        InputError
            If the target cannot reach the impact location in time.
        """
        lateral_start = test.parameter("lateral_start")
        speed = test.parameter("target_speed") * KMH
        side = FROM_LEFT
        if test.parameter("side") == "near":
            side = FROM_RIGHT
        direction = side.turned(test.heading)
        impact_lateral = lateral_offset(test.impact_location, test.vut_width)
        if lateral_start is None:
            if test.acceleration_distance is not None:
                raise InputError(
                    "scenario.parameters",
                    "acceleration_distance: the target starts at its speed",
                    "lateral_start too",
                )
            # The target moves at its speed from the start: with a smaller share of the way, the run
            # begins later.
            time = (test.time_to_impact or TIME_TO_IMPACT) * test.start_share
            distance = speed * time
            profile = TargetProfile(begin=0.0, speed=speed, run_up=0.0)
        else:
            distance = (lateral_start + impact_lateral) * test.start_share
            run_up = test.parameter("acceleration_distance")
            shortest_time = (distance + run_up) / speed
            time = test.time_to_impact or np.maximum(
                TIME_TO_IMPACT, np.ceil(shortest_time / ROUNDING_STEP) * ROUNDING_STEP
            )
            profile = TargetProfile.with_arrival(
                distance, time - test.lead, speed, run_up
            )
        extent = direction.extent(BODIES[test.parameter("target")])
        impact_left = side.left * impact_lateral
        return cls(direction, extent, impact_left, distance, time, profile)


class Crossing(ProtocolTest, frozen=True, kw_only=True):
    """A target crosses the lane ahead of the moving vehicle, and is hit at the impact location if
    nobody brakes.

    For other parameters see `LaneTest`.

    Parameters
    ----------
    test
        Row of the protocol, the source of parameters that are not set here: CPFA, CPNA, CPNCO
        (pedestrians), CBFA, CBNA, CBNAO (cyclists), CCCscp or CMCscp (a car or a motorcyclist at a
        junction).
    speed
        Speed of the vehicle under test at the start [km/h].
    impact_location
        Point of the vehicle's front that would hit the target's middle, from the side where the
        target starts [% of the width]; below 0 or above 100 the target's middle passes behind or
        ahead of the vehicle's corner.
    target, target_speed
        `adult`, `child`, `cyclist`, `motorcyclist` or `car`; its speed once it moves [km/h].
    side
        Side where the target starts: `near` or `far`.
    lateral_start, acceleration_distance
        Distance of the standing target from the middle of the lane, and distance within which it
        reaches its speed [m]. Without a `lateral_start` cyclists, motorcyclists and cars start at
        their speed.
    short
        Distance before the vehicle's path at which a pedestrian stops, who otherwise stops 5 m past
        the middle [m].
    lead
        Time by which a target with a `lateral_start` is at the place of the impact before the
        vehicle [s].
    start_share
        Share of the usual distance to the impact at which the target starts [-].
    heading
        Rotation of the target's path around the point of impact, counterclockwise seen from above
        [degrees].
    hidden
        Whether two parked cars stand between target and vehicle.
    sensor_setback
        Distance of the sensors behind the middle of the front bumper [m].
    time_to_impact, time_after
        Time from the start to the impact, by default 6 s or as long as the target needs, and from
        there to the end of the run [s].

    Notes
    -----
    `lateral` refers to the target's middle, `gap` to the corner or side of its body that is nearest
    along the lane.

    Where the protocol leaves a choice, this class follows Euro NCAP's calculator
    (version 5.4.9). `target_speed`, `start_share` and `heading` express its robustness
    layers. Assumptions where the calculator leaves a choice too:

    - With every layer the target still arrives at the impact location.
    - A faster target starts from the usual position; if it starts at its speed, from
      correspondingly farther away.
    - With a smaller `start_share` a standing target sets off later, and the run of a moving target
      begins with the target nearer.
    - At a junction the middle of the target meets the middle of the front. The target comes from
      the near side; the calculator chooses a side at random.
    """

    test: Literal[
        "CPFA", "CPNA", "CPNCO", "CBNA", "CBFA", "CBNAO", "CCCscp", "CMCscp"
    ] = "CPFA"
    target: Literal["adult", "child", "cyclist", "motorcyclist", "car"] | None = None
    speed: Annotated[
        Speed, searched(10.0, 80.0, "km/h", "speed of the vehicle at the start")
    ] = 40.0
    impact_location: Annotated[
        ImpactLocation,
        searched(
            0.0,
            100.0,
            "%",
            "impact location, share of the vehicle's front from the side where the target starts",
        ),
    ] = 50.0
    target_speed: (
        Annotated[
            float,
            Meta(gt=0, le=150),
            searched(3.0, 60.0, "km/h", "speed of the target"),
        ]
        | None
    ) = None
    side: Literal["near", "far"] | None = None
    lateral_start: Annotated[float, Meta(gt=0, le=12)] | None = None
    acceleration_distance: Metres | None = None
    short: Metres | None = None
    lead: Annotated[float, Meta(ge=0, le=10)] = 0.0
    start_share: PositiveProportion = 1.0
    heading: Heading = 0.0
    hidden: bool | None = None
    sensor_setback: Metres = 0.0
    time_to_impact: Seconds | None = None

    @property
    def stop(self) -> float:
        """Distance from the middle of the lane to the place at which a pedestrian stops [m]. The
        distance is negative if the pedestrian stops before the middle.
        """
        if self.short is None:
            return STOP_DISTANCE
        return (
            -(self.vut_width + BODIES[self.parameter("target")].length) / 2 - self.short
        )

    @property
    def pre_crash(self) -> PreCrash:
        """NHTSA's pre-crash type."""
        return PRE_CRASH[self.parameter("target")]

    def obstacle(self) -> str:
        """Words for the target and the side from which the target comes."""
        target = f"a {self.parameter('target')}".replace("a adult", "an adult")
        pronoun = "who" if self.is_on_foot else "that"
        if self.parameter("hidden"):
            return f"{target} {pronoun} comes out from behind a parked car"
        return f"{target} {pronoun} crosses from the {self.parameter('side')} side"

    @property
    def is_on_foot(self) -> bool:
        """Whether the target is a pedestrian."""
        return self.parameter("target") in PERSONS

    @property
    def duration(self) -> Quantity:
        """Length of a run [s]."""
        return _Start.of(self).time_to_impact + self.time_after

    def check(self) -> None:
        """Refuse a target that cannot reach the place of the impact in time."""
        _Start.of(self)

    def tracks(self, times: FloatArray) -> list[Track]:
        """The tracks of the target and of the parked cars, if there are any, at `times`. The target
        moves on after the place of the impact.
        """
        start = _Start.of(self)
        target = self.parameter("target")
        way = start.profile.travelled(times)
        # The distance from the start at which the target stops: only a pedestrian stops.
        end = np.inf
        if self.is_on_foot:
            impact_lateral = lateral_offset(self.impact_location, self.vut_width)
            end = start.distance_to_impact + self.stop - impact_lateral
        # The distance of the target past the place of the impact; below 0 before the impact.
        path = np.minimum(way, end) - start.distance_to_impact
        speed = np.where(way < end, start.profile.speed_at(times), 0.0)
        # The place of the target's middle at the impact: the nearest side of its body is then at
        # the vehicle's front.
        impact = self.start_speed * start.time_to_impact + start.extent / 2
        x = impact + start.direction.along * path
        y = start.impact_left + start.direction.left * path
        crossing = Track(
            "target", target, *BODIES[target], x, y, *start.direction, speed
        )
        if not self.parameter("hidden"):
            return [crossing]
        return [crossing, *self._parked_cars(impact)]

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """Scenes in which nobody needs to brake: a pedestrian stops before the vehicle's path, a
        pedestrian leaves this path in time, or a car stands in the next lane.
        """
        row = f"{self.test}, {self.speed:g} km/h"
        if (
            self.is_on_foot
            and self.parameter("lateral_start") is not None
            and not self.heading
        ):
            middle = replace(self, impact_location=50.0, start_share=1.0)
            for short in SHORT_OF_PATH:
                yield f"{row}, stops {short:g} m short", replace(middle, short=short)
            for lead in LEADS:
                yield (
                    f"{row}, leaves {lead:g} s before",
                    replace(middle, hidden=False, lead=lead),
                )
        yield from next_lane(self, HEADWAYS[::4])

    def _parked_cars(self, impact: Quantity) -> list[Track]:
        """The tracks of both parked cars beside the lane, and of the row that hides the target.
        `impact` is the place of the impact along the lane [m].
        """
        front = impact - PARKED_GAP
        y = -self.vut_width / 2 - PARKED_GAP - PARKED_WIDTH / 2
        cars = [
            Track.of(
                "row",
                SCREEN,
                front - ROW_LENGTH / 2,
                y,
                size=(ROW_LENGTH, PARKED_WIDTH),
            )
        ]
        for name, length in PARKED_LENGTHS.items():
            cars.append(
                Track.of(
                    name, "car", front - length / 2, y, size=(length, PARKED_WIDTH)
                )
            )
            front = front - length - PARKED_GAP
        return cars
