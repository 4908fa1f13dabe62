"""Benign scenes: scenes like those of the shipped scenarios in which nobody needs to brake.

The pedestrian stops short of the vehicle's path, leaves it in time, or walks beside it; a car stands in the next lane.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

from msgspec.structs import asdict, replace

from safevar_sumo.records import KMH_PER_MS
from safevar_sumo.scenarios.ahead import Along, CarToCar
from safevar_sumo.scenarios.base import Point, Scenario
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.published import LeadVehicleStopped, PedestrianCrossing
from safevar_sumo.scenarios.tracks import BODIES

SHORT_OF_PATH = (0.3, 0.6, 1.0, 1.5, 2.0)
"""Distances from the vehicle's path at which a pedestrian stops [m]."""
LEADS = (1.5, 2.0)
"""Times by which a pedestrian is at the place of the impact before the vehicle [s]: the path is clear half a second
later.
"""
BESIDE = (-50.0, -40.0)
"""Places beside the vehicle's path where a target moves along [% of the vehicle's width from its left corner]."""
LANE_WIDTH = 3.5
"""Distance of the next lane [m]."""
HEADWAYS = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0)
"""Distances of a car in the next lane at the start, as time headways [s]."""
CITY_SPEEDS = (20.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 60.0)
"""Speeds with a car in the next lane of a study whose vehicle starts at rest [km/h]."""
SLOW_SPEEDS, WALKING_SPEED = (10.0, 15.0, 20.0), 1.8 * KMH_PER_MS
"""Speeds near which vehicles reach the published scenario's pedestrian, and his own [km/h]."""


class StopsShort(Crossing, frozen=True, kw_only=True):
    """The pedestrian stops `short` metres before the vehicle's path."""

    short: float = 1.0

    @property
    def stop(self) -> float:
        """Position at which the pedestrian stops, past the middle of the lane [m]."""
        return -(self.vut_width + BODIES[self.parameter("target")].length) / 2 - self.short


class LeavesInTime(Crossing, frozen=True, kw_only=True):
    """The pedestrian is at the place of the impact `seconds` before the vehicle."""

    seconds: float = 2.0

    @property
    def lead(self) -> float:
        """Time by which the pedestrian is there before the vehicle [s]."""
        return self.seconds


class NextLane(CarToCar, frozen=True, kw_only=True):
    """The car stands, or drives more slowly, in the next lane."""

    @property
    def offset(self) -> float:
        """Distance of the car's rear to the right of the lane's middle [m]."""
        return LANE_WIDTH


def benign_points(points: Iterable[Point]) -> list[Point]:
    """Benign scenes for the shipped scenarios at these points, in the points' weathers; none for other scenarios."""
    scenes = dict[str, Point]()
    for point in points:
        for description, scenario in _scenes_like(point.scenario):
            name = f"{description}, {point.weather.name}"
            scenes.setdefault(name, Point(scenario, point.weather, name))
    return list(scenes.values())


def _scenes_like(scenario: Scenario) -> Iterable[tuple[str, Scenario]]:
    """Benign scenes like a scenario, each with a description."""
    if isinstance(scenario, Crossing) and scenario.is_on_foot:
        base = asdict(replace(scenario, impact_location=50.0))
        row = f"{scenario.test}, {scenario.speed:g} km/h"
        for short in SHORT_OF_PATH:
            yield f"{row}, stops {short:g} m short", StopsShort(**base, short=short)
        for seconds in LEADS:
            yield f"{row}, leaves {seconds:g} s before", LeavesInTime(**{**base, "hidden": False}, seconds=seconds)
    if isinstance(scenario, Along):
        for place in BESIDE:
            name = f"{scenario.test}, {scenario.speed:g} km/h, beside at {place:g} %"
            yield name, replace(scenario, impact_location=place)
    if isinstance(scenario, Crossing | Along | CarToCar):
        length, width = scenario.vut_length, scenario.vut_width
        # Every fourth headway is enough where the scenes above differ more from each other.
        for headway in HEADWAYS if isinstance(scenario, CarToCar) else HEADWAYS[::4]:
            name = f"{scenario.speed:g} km/h, a car in the next lane {headway:g} s ahead"
            yield name, NextLane(speed=scenario.speed, headway=headway, vut_length=length, vut_width=width)
    if isinstance(scenario, LeadVehicleStopped):
        for speed, headway in product(CITY_SPEEDS, HEADWAYS):
            yield f"{speed:g} km/h, a car in the next lane {headway:g} s ahead", NextLane(speed=speed, headway=headway)
    if isinstance(scenario, PedestrianCrossing):
        from_near_side = Crossing(test="CPNA", target_speed=WALKING_SPEED, time_to_impact=7.0)
        for walk, speed in product((from_near_side, replace(from_near_side, test="CPFA")), SLOW_SPEEDS):
            yield from _scenes_like(replace(walk, speed=speed))
