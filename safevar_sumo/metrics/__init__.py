"""Safety metrics of method section 4; each module computes one from a trace and its encounter."""

from safevar_sumo.metrics.deceleration import average_deceleration
from safevar_sumo.metrics.safety_degree import safety_degree
from safevar_sumo.metrics.time_to_collision import time_exposed, time_integrated, time_to_collision

METRICS = {
    "safety_degree": safety_degree,
    "tet": time_exposed,
    "tit": time_integrated,
    "ave_dece": average_deceleration,
}

__all__ = ["METRICS", "average_deceleration", "safety_degree", "time_exposed", "time_integrated", "time_to_collision"]
