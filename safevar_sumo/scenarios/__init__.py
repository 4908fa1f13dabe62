"""Scenarios by name."""

from collections.abc import Mapping
from typing import Any

from safevar_sumo.scenarios.ahead import Along
from safevar_sumo.scenarios.base import (
    LOCATION_DIMENSION,
    SPEED_DIMENSION,
    VUT,
    GuardedScenario,
    Lane,
    Point,
    PreCrash,
    Scenario,
    Scene,
    World,
    distance_in_words,
    pre_crash_sentence,
)
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.published import LeadVehicleStopped, PedestrianCrossing
from safevar_sumo.scenarios.weather import WEATHERS, equals_clear, weather_in_words, weather_of

SCENARIOS: Mapping[str, type[Any]] = {
    "pedestrian_crossing": PedestrianCrossing,
    "along": Along,
    "car_to_car": CarToCar,
    "crossing": Crossing,
    "lead_vehicle_stopped": LeadVehicleStopped,
}

__all__ = [
    "LOCATION_DIMENSION",
    "SCENARIOS",
    "SPEED_DIMENSION",
    "VUT",
    "WEATHERS",
    "GuardedScenario",
    "Lane",
    "Point",
    "PreCrash",
    "Scenario",
    "Scene",
    "World",
    "distance_in_words",
    "equals_clear",
    "pre_crash_sentence",
    "weather_in_words",
    "weather_of",
]
