"""Measures by name: the safety metrics (method section 4), and the measures of change."""

from safevar_sumo.metrics.base import (
    F_DIFF as F_DIFF,
    F_NUM_DIFF as F_NUM_DIFF,
    F_SAFE as F_SAFE,
    Measure as Measure,
    Scoring as Scoring,
    checked_measure as checked_measure,
)
from safevar_sumo.metrics.legal import (
    IMPACT_EXCESS as IMPACT_EXCESS,
    IMPACT_SPEED as IMPACT_SPEED,
    MFDD,
    STOP_FROM_PEDAL,
    STOPPING_DISTANCE as STOPPING_DISTANCE,
)
from safevar_sumo.metrics.measures import (
    AVE_DECE,
    DRAC,
    PET,
    REACTION_TIME,
    SAFETY_DEGREE_METRIC,
    TET,
    TIT,
    TTC_MIN,
    UNSAFE_SHARE as UNSAFE_SHARE,
)
from safevar_sumo.metrics.unsafe import (
    CriterionLike as CriterionLike,
    Unsafe as Unsafe,
)
from safevar_sumo.metrics.words import impact_in_words as impact_in_words

METRICS = {metric.name: metric for metric in (SAFETY_DEGREE_METRIC, TET, TIT, AVE_DECE)}
OPTIONAL_METRICS = {
    metric.name: metric
    for metric in (
        STOPPING_DISTANCE,
        STOP_FROM_PEDAL,
        MFDD,
        IMPACT_EXCESS,
        IMPACT_SPEED,
        TTC_MIN,
        DRAC,
        PET,
        REACTION_TIME,
    )
}
"""Metrics that only studies have which name them."""
OBJECTIVES = {
    objective.name: objective for objective in (F_SAFE, F_DIFF, F_NUM_DIFF)
} | {SAFETY_DEGREE_METRIC.name: F_SAFE}
"""Measures that the objectives of a search may name, in addition to metrics."""
PUBLISHED_SCORING = Scoring(
    metrics=tuple(metric.facts for metric in METRICS.values()),
    objectives=(F_SAFE, F_DIFF, F_NUM_DIFF),
)
"""Metrics and objectives of the published study (method sections 3 and 4)."""
