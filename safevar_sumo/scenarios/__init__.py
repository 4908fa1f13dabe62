"""Scenarios and weathers by name, and words for both. The file weather.toml beside this module has
the weathers.
"""

from collections.abc import Mapping, Sequence
from math import isclose

import msgspec

from safevar_sumo.errors import check_name
from safevar_sumo.records import KMH_PER_MS
from safevar_sumo.scenarios.ahead import Along, CarToCar
from safevar_sumo.scenarios.base import (
    VUT as VUT,
    PreCrash as PreCrash,
    Scenario as Scenario,
    Scene as Scene,
    WorldScenario as WorldScenario,
)
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.lane_change import CutIn, CutOut
from safevar_sumo.scenarios.point import (
    SPEED_DIMENSION as SPEED_DIMENSION,
    Point as Point,
)
from safevar_sumo.scenarios.published import LeadVehicleStopped, PedestrianCrossing
from safevar_sumo.scenarios.recorded_tracks import RecordedTracks
from safevar_sumo.scenarios.roads import Lane as Lane, World as World
from safevar_sumo.scenarios.simulated import Simulator as Simulator
from safevar_sumo.scenarios.stop import Stop
from safevar_sumo.scenarios.tracks import (
    Track as Track,
    TrackScenario as TrackScenario,
    travelled as travelled,
)
from safevar_sumo.shipped import shipped_table
from safevar_sumo.study import PHASE, FreeParameter, Weather, free_parameters

SCENARIO_BASES: tuple[type, ...] = (Simulator, TrackScenario, WorldScenario)
"""The contracts of which a user's scenario must fulfil one."""
SCENARIOS: Mapping[str, type[Scenario]] = {
    "pedestrian_crossing": PedestrianCrossing,
    "along": Along,
    "car_to_car": CarToCar,
    "crossing": Crossing,
    "cut_in": CutIn,
    "cut_out": CutOut,
    "lead_vehicle_stopped": LeadVehicleStopped,
    "recorded_tracks": RecordedTracks,
    "stop": Stop,
}

WEATHERS = {
    name: msgspec.convert({"name": name, **table}, Weather)
    for name, table in shipped_table("scenarios/weather.toml").items()
}
"""The shipped weathers by name."""


WEATHER_PARAMETERS = free_parameters(Weather)
"""The parameters of a weather that a study may search, by name."""
PHASES = {
    PHASE: FreeParameter(
        lower=0.0,
        upper=1.0,
        unit="-",
        meaning="phase, by which the encounter begins later, in steps",
    )
}
"""The phase as a parameter that a study may search, for encounters that have a phase."""


def searchable_in(scenario: Scenario) -> Mapping[str, FreeParameter]:
    """The parameters of a scenario and its weather that a study may search. A scenario without an
    encounter has none.
    """
    if scenario.brakes_fully:
        return {}
    parameters = free_parameters(type(scenario))
    if scenario.mover.has("weather"):
        parameters |= WEATHER_PARAMETERS
    if scenario.has_phase:
        parameters |= PHASES
    return parameters


def unit_of(scenario: Scenario, name: str) -> str:
    """The unit of a parameter that a matrix varies; "" if the unit is unknown."""
    searchable = searchable_in(scenario)
    if name in searchable:
        return searchable[name].unit
    # A scenario that does not declare its speed as searchable states no unit. If the number equals
    # the test speed in km/h, the unit is km/h.
    speed = KMH_PER_MS * (scenario.test_speed or 0.0)
    if name == SPEED_DIMENSION and isclose(getattr(scenario, name), speed):
        return "km/h"
    return ""


def weather_of(choice: str | Weather) -> Weather:
    """The weather that a study names or defines.

    Raises
    ------
    InputError
        If there is no weather of that name.
    """
    if isinstance(choice, Weather):
        return choice
    # A study with a simulator of the user's own names no weather: "" counts as clear weather.
    choice = choice or "clear"
    check_name(
        "",
        f"weather = {choice!r}",
        choice,
        WEATHERS,
        f", or a table with {', '.join(Weather.__struct_fields__)}",
    )
    return WEATHERS[choice]


def equals_clear(weather: Weather) -> bool:
    """Return whether a weather with another name has the same effects as clear weather."""
    clear = WEATHERS["clear"]
    return (
        weather.name != clear.name
        and msgspec.structs.replace(weather, name=clear.name) == clear
    )


FROM_CENTRES = " from centre to centre"
"""The words after a safety degree that is measured between the centres of bodies."""


def distance_in_words(safety_degree: float, contact: float, digits: int = 2) -> str:
    """A safety degree above 0 as text. If bodies touch at a safety degree of `contact` above 0 [m],
    the text also has the gap.
    """
    text = f"{safety_degree:.{digits}f} m"
    if not contact:
        return text
    gap = f"{round(safety_degree - contact, digits) + 0.0:.{digits}f}"
    return f"{text}{FROM_CENTRES} (gap {gap} m)"


def pre_crash_sentence(points: Sequence[Point]) -> str:
    """A sentence that lists the pre-crash types and the light of points; "" if no scenario has a
    type.
    """
    types = dict.fromkeys(
        point.scenario.pre_crash for point in points if point.scenario.pre_crash
    )
    light = " and ".join(dict.fromkeys(f"by {point.weather.light}" for point in points))
    if not types:
        return ""
    return f"NHTSA's pre-crash types: {'; '.join(types)}; {light}."
