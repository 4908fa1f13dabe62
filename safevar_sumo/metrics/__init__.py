"""Metrics by name: the safety metrics of method section 4, and metrics of comfort."""

from safevar_sumo.metrics.base import F_DIFF, F_NUM_DIFF, F_SAFE, Metric, MetricFacts, Objective, Scoring, guard_metric
from safevar_sumo.metrics.comfort import BRAKE_HARSHNESS, MAX_JERK, RMS_ACCELERATION
from safevar_sumo.metrics.deceleration import AVE_DECE
from safevar_sumo.metrics.rating_points import RATING_POINTS
from safevar_sumo.metrics.safety_degree import SAFETY_DEGREE_METRIC
from safevar_sumo.metrics.time_to_collision import TET, TIT, time_to_collision
from safevar_sumo.metrics.unsafe import Criterion, Unsafe

METRICS = {metric.name: metric for metric in (
    SAFETY_DEGREE_METRIC,
    TET,
    TIT,
    AVE_DECE,
)}
FURTHER = {metric.name: metric for metric in (
    MAX_JERK,
    RMS_ACCELERATION,
    BRAKE_HARSHNESS,
)}
"""Metrics that a study has only if it names them."""
OBJECTIVES = {F_SAFE.name: SAFETY_DEGREE_METRIC, "f_comfort": MAX_JERK}
"""By name of an objective: the metric that it uses."""
SAFEVAR = Scoring(metrics=tuple(metric.facts for metric in METRICS.values()), objectives=(F_SAFE, F_DIFF, F_NUM_DIFF))
"""Metrics and objectives of the published study (method sections 3 and 4)."""

__all__ = [
    "FURTHER", "F_DIFF", "F_NUM_DIFF", "F_SAFE", "METRICS", "OBJECTIVES", "RATING_POINTS", "SAFEVAR", "Criterion", "Metric", "MetricFacts",
    "Objective", "Scoring", "Unsafe", "guard_metric", "time_to_collision"]
