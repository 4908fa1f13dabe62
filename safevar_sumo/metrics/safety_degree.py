"""The safety degree, f_safe of the paper (method section 4)."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.study import SAFETY_DEGREE, MetricsTable


def safety_degree(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Least separation during the encounter [m, > 0], or minus the speed of the collision [m/s, <= 0].

    Shape (N,); NaN where there was neither an encounter nor a collision.
    """
    is_counted = runs.trace.active & runs.encounter.in_conflict
    least_separation = np.min(np.where(is_counted, runs.encounter.separation, np.inf), axis=0)
    least_separation = np.where(np.isfinite(least_separation), least_separation, np.nan)
    return np.where(np.isnan(runs.collision_speed), least_separation, -runs.collision_speed)


SAFETY_DEGREE_METRIC = Metric(
    name=SAFETY_DEGREE,
    title="SD",
    unit="m, or -m/s",
    head="SD",
    more_is_unsafe=False,
    function=safety_degree,
    description="Least separation during the encounter [m, > 0], or minus the speed of the collision [m/s, <= 0].",
)
