"""Statistical tests of samples and runs (docs/method.md, section 7): Mann-Whitney U, Wilcoxon's signed ranks, effect
sizes, and Holm's correction for many tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import count
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.records import FloatArray

ALPHA = 0.01
"""A p-value below this level is significant."""
FEWEST_RUNS = {
    "RQ1": next(n for n in count(1) if 2 / 2**n < ALPHA),
    "RQ2": next(n for n in count(1) if 2 / math.comb(2 * n, n) < ALPHA),
}
"""Smallest number of runs with which a test can be significant before any correction, by question.

The smallest two-sided p-value of n runs is 2 / 2^n by RQ1's signed-rank test, and 2 / C(2n, n) by RQ2's U test.
"""
EXACT_SAMPLE_SIZE = 8
"""Without ties, the p-value of U is exact if one sample has at most this many values; otherwise it is a normal
approximation."""
MAX_EXACT_RUNS = 50
"""Without ties and differences of zero, the signed-rank test is exact for up to this many runs."""
EXACT_TEST = "Mann-Whitney U, two-sided, exact"
ASYMPTOTIC_TEST = "Mann-Whitney U, two-sided, normal approximation with corrections for ties and continuity"
EXACT_SIGNED_TEST = "Wilcoxon signed-rank, two-sided, exact"
ASYMPTOTIC_SIGNED_TEST = "Wilcoxon signed-rank, two-sided, normal approximation with correction for continuity"
MAGNITUDES = ((0.714, "large"), (0.638, "medium"), (0.556, "small"))
"""Kitchenham's magnitudes; each holds from this value of max(A12, 1 - A12) on."""
NOTABLE_MAGNITUDES = ("medium", "large")


class TwoSampleTest(NamedTuple):
    """Comparison of two samples X and Y; NaN and None where a sample is empty.

    `effect_size` is Vargha-Delaney's A12 = P(X > Y) + 0.5 P(X = Y), `n1` and `n2` the samples' sizes, `method` the name
    of the test.
    """

    p_value: float
    effect_size: float
    magnitude: str | None
    n1: int
    n2: int
    method: str | None

    def reversed(self) -> TwoSampleTest:
        """The test with the effect size of Y against X, 1 - A12, whose magnitude is the same."""
        return self._replace(effect_size=1 - self.effect_size)


def compare_samples(x: ArrayLike, y: ArrayLike) -> TwoSampleTest:
    """Compare two samples without undefined values by U test and effect size."""
    first, second = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if not first.size or not second.size:
        return TwoSampleTest(np.nan, np.nan, None, first.size, second.size, None)
    is_exact = min(first.size, second.size) <= EXACT_SAMPLE_SIZE and has_distinct_values([*first, *second])
    name, method = (EXACT_TEST, "exact") if is_exact else (ASYMPTOTIC_TEST, "asymptotic")
    test = scipy.stats.mannwhitneyu(first, second, method=method, nan_policy="raise")
    a12 = float(test.statistic) / (first.size * second.size)
    return TwoSampleTest(float(test.pvalue), a12, magnitude_of(a12), first.size, second.size, name)


def has_distinct_values(values: ArrayLike) -> bool:
    return np.unique(values).size == np.size(values)


def magnitude_of(effect_size: float) -> str:
    """The magnitude of an effect size, by Kitchenham's intervals."""
    # Without its rounding error, 1 - 0.286 is a large effect like 0.714.
    folded_effect = round(max(effect_size, 1 - effect_size), 12)
    return next((name for limit, name in MAGNITUDES if folded_effect >= limit), "negligible")


def signed_rank_test(sample: ArrayLike, value: float) -> TwoSampleTest:
    """Compare independent values, shape (N,), with one value by Wilcoxon's test; the effect size is the share of
    greater values.

    The test drops values equal to `value` (as Wilcoxon did); the effect size counts them by half.
    """
    differences = np.asarray(sample, dtype=float) - value
    if not differences.size or np.isnan(value):
        return TwoSampleTest(np.nan, np.nan, None, differences.size, 0, None)
    if not differences.any():
        return TwoSampleTest(1.0, 0.5, magnitude_of(0.5), differences.size, 1, EXACT_SIGNED_TEST)
    effect = float(np.mean(differences > 0) + np.mean(differences == 0) / 2)
    is_exact = differences.size <= MAX_EXACT_RUNS and has_distinct_values([0.0, *np.abs(differences)])
    name, method = (EXACT_SIGNED_TEST, "exact") if is_exact else (ASYMPTOTIC_SIGNED_TEST, "approx")
    test = scipy.stats.wilcoxon(differences, correction=not is_exact, method=method)
    return TwoSampleTest(float(test.pvalue), effect, magnitude_of(effect), differences.size, 1, name)


def correct_by_holm(p_values: Iterable[float]) -> FloatArray:
    """Correct p-values by Holm's step-down method (Holm 1979); NaN stays NaN and does not count as a test."""
    values = pd.Series(list(p_values), dtype=float)
    ascending = values.dropna().sort_values()
    corrected = (ascending * np.arange(len(ascending), 0, -1)).clip(upper=1.0).cummax()
    return np.asarray(corrected.reindex(values.index), dtype=float)
