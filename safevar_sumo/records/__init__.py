"""Records that pass between the stages: observations and commands of an ADS, traces of runs, evaluations."""

from safevar_sumo.records.base import (
    ALL_TRUE,
    GRAVITY,
    KMH_PER_MS,
    STANDSTILL,
    TIME_DECIMALS,
    TIME_ROUNDING,
    TOUCH_OVERLAP,
    UNDEFINED,
    ZERO,
    BoolArray,
    FloatArray,
    IntArray,
    finite_or_none,
)
from safevar_sumo.records.driving import Command, Nominal, Observation, PedalTables
from safevar_sumo.records.evaluations import CellResults, Evaluations
from safevar_sumo.records.runs import NO_CONTACT, Contact, Encounter, Outcome, SimulationRuns, Trace

__all__ = [
    "ALL_TRUE",
    "GRAVITY",
    "KMH_PER_MS",
    "NO_CONTACT",
    "STANDSTILL",
    "TIME_DECIMALS",
    "TIME_ROUNDING",
    "TOUCH_OVERLAP",
    "UNDEFINED",
    "ZERO",
    "BoolArray",
    "CellResults",
    "Command",
    "Contact",
    "Encounter",
    "Evaluations",
    "FloatArray",
    "IntArray",
    "Nominal",
    "Observation",
    "Outcome",
    "PedalTables",
    "SimulationRuns",
    "Trace",
    "finite_or_none",
]
