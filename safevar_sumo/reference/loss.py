"""What a study's disagreement with its references costs; see `FitTable`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.reference.agreement import Agreement
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import FitTable

LARGEST = 1e3
"""Of what a reference can cost; that of a study which cannot be simulated at all."""
FARTHEST = 10.0
"""Tolerances beyond which the original vehicle's miss costs no more: a value that there is not is so far away."""


def original_cost(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> float:
    """Misses of the original vehicle's values, weighted by metric; mean.

    Squared up to the tolerance and in proportion beyond it (Huber 1964): squares would have a search fit one vehicle first, and
    the rows only as far as that leaves it room.
    """
    misses = [fit.weights.get(name, 0.0) * _huber(original.metrics[name][0] / value - 1, fit.tolerance)
              for name, value in published.items() if name in METRICS]
    return fit.original * float(np.mean(misses)) if misses else 0.0


def _huber(miss: float, tolerance: float) -> float:
    """A relative miss in tolerances, squared up to one; twice as much, less one, beyond."""
    distance = min(abs(miss) / tolerance, FARTHEST) if np.isfinite(miss) else FARTHEST
    return distance * distance if distance <= 1 else 2 * distance - 1


def reference_cost(told: Agreement, data: ReferenceData, fit: FitTable) -> float:
    """Lost rank correlation and absolute error (in standard deviations of the reference), weighted, and collisions."""
    cost = 0.0
    for name, weight in fit.weights.items():
        values = data.metrics[name][~np.isnan(data.metrics[name])]
        if not values.size or np.ptp(values) == 0:
            continue
        rho, error = told.spearman[name], told.mean_absolute_error[name]
        cost += weight * (fit.rank * (1 - (rho or 0.0)) + (np.inf if error is None else error) / float(np.std(values)))
    collisions = told.collisions
    missed = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
    return min(cost, LARGEST) + fit.collisions * missed / max(told.rows, 1)
