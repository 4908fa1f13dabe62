"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): model descriptions, units, and instances, by FMPy."""

from safevar_sumo.fmu.description import (
    REAL_TYPES as REAL_TYPES,
    Description as Description,
    description_of as description_of,
    file_of as file_of,
)
from safevar_sumo.fmu.instances import Fleet as Fleet, History as History, Instances as Instances
