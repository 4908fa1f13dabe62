"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): model descriptions, units, and instances in separate processes."""

from safevar_sumo.fmu.description import REAL_TYPES, Description, Variable, description_of, file_of
from safevar_sumo.fmu.instances import LONGEST, Fault, Fleet, History, Instances
from safevar_sumo.fmu.ports import Port, constants_of, ports_of
from safevar_sumo.fmu.units import COMMON_UNITS, SI, Unit

__all__ = [
    "COMMON_UNITS", "LONGEST", "REAL_TYPES", "SI", "Description", "Fault", "Fleet", "History", "Instances", "Port", "Unit", "Variable",
    "constants_of", "description_of", "file_of", "ports_of"]
