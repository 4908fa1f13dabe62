"""Points that cover a domain evenly, and what a sample says about a share."""

from __future__ import annotations

import math

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import CharacteristicSet

Interval = tuple[float, float]
"""Lower and upper end."""
CONFIDENCE = 0.95
"""Confidence level of the intervals of shares, unless an option sets another level."""


def sobol_points(number: int, dimensions: int, seed: int) -> FloatArray:
    """Scrambled Sobol points in the unit cube, shape (number, dimensions); they are most even if `number` is a power of
    two.
    """
    import scipy  # takes longer to load than a simulation

    sequence = scipy.stats.qmc.Sobol(dimensions, rng=np.random.default_rng(seed))
    exponent = max(0, math.ceil(math.log2(number)))
    return np.asarray(sequence.random_base2(exponent)[:number])


def sobol_settings(characteristics: CharacteristicSet, number: int, seed: int = 0) -> FloatArray:
    """`number` settings that cover the whole domain evenly, shape (number, n), feasible or not."""
    lower = characteristics.lower
    upper = characteristics.upper
    return lower + sobol_points(number, len(characteristics), seed) * (upper - lower)


def clopper_pearson(count: int, total: int, confidence: float = CONFIDENCE) -> Interval:
    """Exact confidence interval (Clopper and Pearson) of the share `count` / `total`."""
    import scipy

    interval = scipy.stats.binomtest(count, total).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
