"""Scenarios by name."""

from safevar_sumo.scenarios.base import VUT, Scenario, Scene, World
from safevar_sumo.scenarios.lead_vehicle_stopped import LeadVehicleStopped
from safevar_sumo.scenarios.pedestrian_crossing import PedestrianCrossing
from safevar_sumo.scenarios.weather import WEATHERS, weather_of

SCENARIOS = {
    "pedestrian_crossing": PedestrianCrossing,
    "lead_vehicle_stopped": LeadVehicleStopped,
}

__all__ = ["SCENARIOS", "VUT", "WEATHERS", "Scenario", "Scene", "World", "weather_of"]
