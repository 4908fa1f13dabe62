"""Two samples compared: Mann-Whitney U, and how large the difference is (method section 7)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.errors import InputError

ALPHA = 0.01
"""Below it a p-value is called significant."""
EXACT_UP_TO = 8
"""Without ties, p is exact if a sample is no larger; else it is the normal approximation."""
EXACT = "Mann-Whitney U, two-sided, exact"
ASYMPTOTIC = "Mann-Whitney U, two-sided, normal approximation with corrections for ties and continuity"
MAGNITUDES = ((0.714, "large"), (0.638, "medium"), (0.556, "small"))
"""Kitchenham's: from which distance to either end an effect size is how large."""
NOTABLE = ("medium", "large")


class Comparison(NamedTuple):
    """Two samples X and Y compared; None where one of them is empty.

    `effect_size` is Vargha-Delaney's A12 = P(X > Y) + 0.5 P(X = Y), `n1` and `n2` the samples' sizes.
    """

    p_value: float | None
    effect_size: float | None
    magnitude: str | None
    n1: int
    n2: int
    method: str | None

    @property
    def reversed_effect(self) -> float | None:
        """A21 = 1 - A12."""
        return None if self.effect_size is None else 1 - self.effect_size


def compare(x: ArrayLike, y: ArrayLike) -> Comparison:
    """Compare two samples by U test and effect size.

    Raises
    ------
    InputError
        If a value is NaN.
    """
    one, other = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if np.isnan(one).any() or np.isnan(other).any():
        raise InputError("Mann-Whitney U", "a value is NaN", "samples without undefined values")
    if not one.size or not other.size:
        return Comparison(None, None, None, one.size, other.size, None)
    both = np.concatenate([one, other])
    exact = min(one.size, other.size) <= EXACT_UP_TO and np.unique(both).size == both.size
    test = scipy.stats.mannwhitneyu(one, other, alternative="two-sided", method="exact" if exact else "asymptotic")
    a12 = float(test.statistic) / (one.size * other.size)
    return Comparison(float(test.pvalue), a12, magnitude(a12), one.size, other.size, EXACT if exact else ASYMPTOTIC)


def too_few(n1: int, n2: int) -> bool:
    """Whether samples are so small that not even two which do not overlap differ significantly."""
    return 2 / math.comb(n1 + n2, n1) >= ALPHA


def magnitude(effect_size: float) -> str:
    """How large an effect size is, by Kitchenham's intervals."""
    distance = round(max(effect_size, 1 - effect_size), 12)
    return next((name for least, name in MAGNITUDES if distance >= least), "negligible")
