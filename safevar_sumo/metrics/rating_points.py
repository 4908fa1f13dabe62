"""Points of a Euro NCAP rating: a metric of a vehicle, not of one of its simulations."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable


def _of_one_cell(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Undefined for a single cell: the rater of a matrix computes the points from all cells."""
    return np.full(len(runs.outcome), np.nan)


RATING_POINTS = Metric(
    name="rating_points", title="points kept", unit="points", more_is_unsafe=False, function=_of_one_cell,
    description="Points of Euro NCAP's crash avoidance rating, frontal collisions, in all tests that are simulated.")
