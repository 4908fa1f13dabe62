"""Simulation: many settings of a study in one SUMO process."""

from safevar_sumo.sumo.batch import is_recorded, reason_for_sumo, score
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import (
    PointResult,
    evaluate,
    evaluations_at_worst_points,
    point_record,
    settings_per_batch,
    simulate,
    simulate_all_points,
    study_at,
    system_at_point,
    system_at_worst_point,
    vehicle_remarks,
    worst_points,
)
from safevar_sumo.sumo.system import System, assemble, models_of

__all__ = [
    "Engine",
    "PointResult",
    "System",
    "assemble",
    "evaluate",
    "evaluations_at_worst_points",
    "is_recorded",
    "models_of",
    "point_record",
    "reason_for_sumo",
    "score",
    "settings_per_batch",
    "simulate",
    "simulate_all_points",
    "study_at",
    "system_at_point",
    "system_at_worst_point",
    "vehicle_remarks",
    "worst_points",
]
