"""Simulation: many settings of a study in one SUMO process."""

from safevar_sumo.sumo.batch import reason_for_sumo, score
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import (
    AtPoint,
    aggregated,
    at_every_point,
    at_worst,
    evaluate,
    named_point,
    point_record,
    remarks_of,
    settings_per_batch,
    simulate,
    study_at,
    vehicle_remarks,
    worst_points,
)
from safevar_sumo.sumo.network import network_files, network_fingerprint
from safevar_sumo.sumo.system import System, assemble, models_of

__all__ = [
    "AtPoint", "Engine", "System", "aggregated", "assemble", "at_every_point", "at_worst", "evaluate", "models_of", "named_point",
    "network_files", "network_fingerprint", "point_record", "reason_for_sumo", "remarks_of", "score", "settings_per_batch", "simulate",
    "study_at", "vehicle_remarks", "worst_points"]
