"""Metrics by name: the safety metrics of method section 4, and metrics of comfort."""

from safevar_sumo.metrics.base import (
    F_DIFF as F_DIFF,
    F_NUM_DIFF as F_NUM_DIFF,
    F_SAFE as F_SAFE,
    Metric as Metric,
    MetricFacts as MetricFacts,
    Objective as Objective,
    Scoring as Scoring,
    checked_metric as checked_metric,
)
from safevar_sumo.metrics.measures import (
    AVE_DECE,
    BRAKE_HARSHNESS,
    MAX_JERK,
    RATING_POINTS as RATING_POINTS,
    RMS_ACCELERATION,
    SAFETY_DEGREE_METRIC,
    STOPPING_DISTANCE as STOPPING_DISTANCE,
    TET,
    TIT,
    time_to_collision as time_to_collision,
)
from safevar_sumo.metrics.unsafe import Criterion as Criterion, Unsafe as Unsafe, margin_of as margin_of

METRICS = {metric.name: metric for metric in (SAFETY_DEGREE_METRIC, TET, TIT, AVE_DECE)}
OPTIONAL_METRICS = {metric.name: metric for metric in (MAX_JERK, RMS_ACCELERATION, BRAKE_HARSHNESS, STOPPING_DISTANCE)}
"""Metrics that only the studies have that name them."""
METRIC_OF_OBJECTIVE = {F_SAFE.name: SAFETY_DEGREE_METRIC, "f_comfort": MAX_JERK}
"""The metric that an objective uses, by the objective's name."""
PUBLISHED_SCORING = Scoring(
    metrics=tuple(metric.facts for metric in METRICS.values()), objectives=(F_SAFE, F_DIFF, F_NUM_DIFF)
)
"""Metrics and objectives of the published study (method sections 3 and 4)."""
