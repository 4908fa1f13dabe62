"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): model descriptions, units, and instances in separate processes."""

from safevar_sumo.fmu.description import CONVERTIBLE, Description, Variable, description_of, file_of
from safevar_sumo.fmu.instances import LONGEST, Fault, Fleet, History, Instances
from safevar_sumo.fmu.ports import Port, fixed_of, ports_of
from safevar_sumo.fmu.units import SI, USUAL, Unit

__all__ = [
    "CONVERTIBLE", "LONGEST", "SI", "USUAL", "Description", "Fault", "Fleet", "History", "Instances", "Port", "Unit", "Variable",
    "description_of", "file_of", "fixed_of", "ports_of"]
