"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): model descriptions, units, and instances in separate processes."""

from safevar_sumo.fmu.description import REAL_TYPES, Description, Variable, description_of, file_of
from safevar_sumo.fmu.instances import STEP_LIMIT, Fault, Fleet, History, Instances
from safevar_sumo.fmu.ports import Port, constants_of, ports_of
from safevar_sumo.fmu.units import COMMON_UNITS, SI, Unit

__all__ = [
    "COMMON_UNITS", "REAL_TYPES", "SI", "STEP_LIMIT", "Description", "Fault", "Fleet", "History", "Instances", "Port", "Unit", "Variable",
    "constants_of", "description_of", "file_of", "ports_of"]
