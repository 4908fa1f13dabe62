"""Safety metrics of method section 4: one record each, of a function of drives and what tables need to know of it."""

from safevar_sumo.metrics.base import Metric, MetricFacts, foreign_metric
from safevar_sumo.metrics.deceleration import AVE_DECE
from safevar_sumo.metrics.safety_degree import SAFETY_DEGREE_METRIC
from safevar_sumo.metrics.scoring import F_DIFF, F_NUM_DIFF, F_SAFE, Objective, Scoring
from safevar_sumo.metrics.time_to_collision import TET, TIT, time_to_collision

METRICS = {metric.name: metric for metric in (
    SAFETY_DEGREE_METRIC,
    TET,
    TIT,
    AVE_DECE,
)}
SAFEVAR = Scoring(metrics=tuple(metric.facts for metric in METRICS.values()), objectives=(F_SAFE, F_DIFF, F_NUM_DIFF))
"""What the published study measures and minimises (method sections 3 and 4)."""

__all__ = ["F_DIFF", "F_NUM_DIFF", "F_SAFE", "METRICS", "SAFEVAR", "Metric", "MetricFacts", "Objective", "Scoring", "foreign_metric",
           "time_to_collision"]
