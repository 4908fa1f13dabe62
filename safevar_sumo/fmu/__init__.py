"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): model descriptions, units, and instances, by FMPy."""

from safevar_sumo.fmu.description import REAL_TYPES, Description, declared, description_of, file_of
from safevar_sumo.fmu.instances import Fleet, History, Instances
from safevar_sumo.fmu.ports import Port, constants_of, ports_of
from safevar_sumo.fmu.units import COMMON_UNITS, SI, Unit

__all__ = [
    "COMMON_UNITS",
    "REAL_TYPES",
    "SI",
    "Description",
    "Fleet",
    "History",
    "Instances",
    "Port",
    "Unit",
    "constants_of",
    "declared",
    "description_of",
    "file_of",
    "ports_of",
]
