"""Simulation: many settings of a study in one SUMO process."""

from safevar_sumo.sumo.batch import is_recorded, reason_for_sumo
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, settings_per_batch, simulate, simulate_all_points, vehicle_remarks
from safevar_sumo.sumo.system import assemble

__all__ = [
    "Engine",
    "assemble",
    "evaluate",
    "is_recorded",
    "reason_for_sumo",
    "settings_per_batch",
    "simulate",
    "simulate_all_points",
    "vehicle_remarks",
]
