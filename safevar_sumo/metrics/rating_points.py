"""Points of a Euro NCAP rating: a metric of a vehicle, not of a single simulation."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable


def _undefined_points(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """NaN, shape (N,): a single cell has no points; the rater computes them from all cells of the matrix."""
    return np.full(len(runs.outcome), np.nan)


RATING_POINTS = Metric(
    name="rating_points",
    title="points kept",
    unit="points",
    more_is_unsafe=False,
    function=_undefined_points,
    description="Points of Euro NCAP's crash avoidance rating, frontal collisions, in all tests that are simulated.",
)
