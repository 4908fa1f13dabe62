"""Vehicle models by name, and their characteristics."""

from collections.abc import Mapping
from typing import Any

from safevar_sumo.vehicles.base import LEVEL, GuardedVehicle, Slope, SumoType, Vehicle, VehicleState, slope_of
from safevar_sumo.vehicles.calibration_drive import calibration_drive
from safevar_sumo.vehicles.carla import Carla
from safevar_sumo.vehicles.characteristics import CHANGES, Change, Characteristic, CharacteristicSet, guard_change
from safevar_sumo.vehicles.fmu import FmuVehicle
from safevar_sumo.vehicles.lgsvl import Lgsvl
from safevar_sumo.vehicles.region import FeasibleRegion, region_of
from safevar_sumo.vehicles.sensors import Sensors
from safevar_sumo.vehicles.sumo import SumoVehicle
from safevar_sumo.vehicles.worn import WornVehicle

VEHICLES: Mapping[str, type[Any]] = {"carla": Carla, "lgsvl": Lgsvl, "sumo": SumoVehicle, "worn": WornVehicle}

__all__ = [
    "CHANGES",
    "LEVEL",
    "VEHICLES",
    "Carla",
    "Change",
    "Characteristic",
    "CharacteristicSet",
    "FeasibleRegion",
    "FmuVehicle",
    "GuardedVehicle",
    "Sensors",
    "Slope",
    "SumoType",
    "Vehicle",
    "VehicleState",
    "calibration_drive",
    "guard_change",
    "region_of",
    "slope_of",
]
