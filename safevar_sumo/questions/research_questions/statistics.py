"""Statistics of samples and runs (docs/method.md, section 7): Mann-Whitney U, Wilcoxon's signed
ranks, effect sizes, medians, their intervals, and Holm's correction for many tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import Decimal
from itertools import count
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.questions.sampling import Interval
from safevar_sumo.records import FloatArray

ALPHA = 0.01
"""By default, a p-value below this level is significant, and intervals have the confidence 1 -
ALPHA.
"""
EXACT_SAMPLE_SIZE = 8
"""Without ties, the p-value of U is exact if one sample has at most this many values; otherwise it
is a normal approximation.
"""
MAX_EXACT_RUNS = 50
"""Without ties and differences of zero, the signed-rank test is exact for up to this many runs."""
RANKED_DIGITS = 12
"""Number of significant digits of a value that is ranked: values that only rounding errors
distinguish are ties.
"""
EXACT_TEST = "Mann-Whitney U, two-sided, exact"
ASYMPTOTIC_TEST = (
    "Mann-Whitney U, two-sided, normal approximation with corrections for"
    " ties and continuity"
)
EXACT_SIGNED_TEST = "Wilcoxon signed-rank, two-sided, exact"
ASYMPTOTIC_SIGNED_TEST = (
    "Wilcoxon signed-rank, two-sided, normal approximation with correction"
    " for continuity"
)
MAGNITUDES = ((0.714, "large"), (0.638, "medium"), (0.556, "small"))
"""Kitchenham's magnitudes; each holds from this value of max(A12, 1 - A12) on."""


def fewest_runs(question: str, alpha: float = ALPHA, tests: int = 1) -> int:
    """Smallest number of runs of every algorithm with which a test of RQ1 or RQ2 can be
    significant, after Holm's correction for so many tests.
    """
    return next(n for n in count(1) if can_be_significant(question, n, n, alpha, tests))


def can_be_significant(
    question: str, m: int, n: int, alpha: float = ALPHA, tests: int = 1
) -> bool:
    """Whether a test of m runs, of RQ2 against n runs of another algorithm, can be significant
    after Holm's correction for so many tests.

    The smallest two-sided p-value is 2 / 2^m by the exact distribution of RQ1's signed-rank test,
    and 2 / C(m + n, n) by that of RQ2's U test. Holm multiplies the smallest one of a family by the
    number of its tests.
    """
    orders = 2**m if question == "RQ1" else math.comb(m + n, n)
    return 2 * max(tests, 1) / orders < alpha


class TwoSampleTest(NamedTuple):
    """Comparison of two samples X and Y; NaN and None where a sample is empty.

    `effect_size` is Vargha-Delaney's A12 = P(X > Y) + 0.5 P(X = Y), `n1` and `n2` the samples'
    sizes, `method` the name of the test.
    """

    p_value: float
    effect_size: float
    magnitude: str | None
    n1: int
    n2: int
    method: str | None

    def oriented(self, *, larger_is_better: bool) -> TwoSampleTest:
        """The test whose effect size is above 0.5 where X is better: A12, or 1 - A12 where smaller
        values are better.
        """
        if larger_is_better:
            return self
        return self._replace(effect_size=1 - self.effect_size)


def compare_samples(x: ArrayLike, y: ArrayLike) -> TwoSampleTest:
    """Compare two samples without undefined values by U test and effect size."""
    sample = rounded_to_rank(x)
    baseline = rounded_to_rank(y)
    if not sample.size or not baseline.size:
        return TwoSampleTest(np.nan, np.nan, None, sample.size, baseline.size, None)
    name, method = ASYMPTOTIC_TEST, "asymptotic"
    is_small = min(sample.size, baseline.size) <= EXACT_SAMPLE_SIZE
    if is_small and has_distinct_values([*sample, *baseline]):
        name, method = EXACT_TEST, "exact"
    test = scipy.stats.mannwhitneyu(sample, baseline, method=method, nan_policy="raise")
    a12 = float(test.statistic) / (sample.size * baseline.size)
    return TwoSampleTest(
        float(test.pvalue), a12, magnitude_of(a12), sample.size, baseline.size, name
    )


def rounded_to_rank(values: ArrayLike) -> FloatArray:
    """Values with `RANKED_DIGITS` significant digits, of any shape, in one dimension."""
    return np.array(_decimals(values), float)


def _decimals(values: ArrayLike) -> list[Decimal]:
    return [
        Decimal(f"{value:.{RANKED_DIGITS}g}") for value in np.ravel(values).tolist()
    ]


def has_distinct_values(values: ArrayLike) -> bool:
    return np.unique(values).size == np.size(values)


def magnitude_of(effect_size: float) -> str:
    """The magnitude of an effect size, by Kitchenham's intervals."""
    # Without its rounding error, 1 - 0.286 is a large effect like 0.714.
    folded_effect = round(max(effect_size, 1 - effect_size), 12)
    return next(
        (name for limit, name in MAGNITUDES if folded_effect >= limit), "negligible"
    )


def signed_rank_test(x: ArrayLike, y: ArrayLike = 0.0) -> TwoSampleTest:
    """Compare pairs, each of shape (N,), or values with one value, by Wilcoxon's test; the effect
    size is the share of pairs in which x is greater.

    The test drops differences of 0 (as Wilcoxon did); the effect size counts them by half.
    """
    # Differences of decimal numbers have no rounding errors.
    pairs = zip(_decimals(x), _decimals(np.broadcast_to(y, np.shape(x))), strict=True)
    differences = np.array([value - baseline for value, baseline in pairs], float)

    # No test of undefined values.
    if not differences.size or np.isnan(differences).any():
        return TwoSampleTest(np.nan, np.nan, None, differences.size, 0, None)

    # The effect, and the exact test if no values are tied.
    effect = float(np.mean(differences > 0) + np.mean(differences == 0) / 2)
    p_value, name = 1.0, EXACT_SIGNED_TEST
    if differences.any():
        is_distinct = has_distinct_values([0.0, *np.abs(differences)])
        is_exact = differences.size <= MAX_EXACT_RUNS and is_distinct
        method = "exact" if is_exact else "approx"
        test = scipy.stats.wilcoxon(differences, correction=not is_exact, method=method)
        p_value = float(test.pvalue)
        name = EXACT_SIGNED_TEST if is_exact else ASYMPTOTIC_SIGNED_TEST
    return TwoSampleTest(
        p_value, effect, magnitude_of(effect), differences.size, 1, name
    )


def correct_by_holm(p_values: Iterable[float]) -> FloatArray:
    """Correct p-values by Holm's step-down method (Holm 1979); NaN stays NaN and does not count as
    a test.
    """
    values = pd.Series(list(p_values), dtype=float)
    ascending = values.dropna().sort_values()
    corrected = (ascending * np.arange(len(ascending), 0, -1)).clip(upper=1.0).cummax()
    return np.asarray(corrected.reindex(values.index), float)


def effect_interval(effect: float, m: int, n: float, alpha: float = ALPHA) -> Interval:
    """The interval of an effect size of m against n values, or if n is NaN against one, at the
    confidence 1 - alpha.

    It holds the values that differ from the effect by at most as many standard errors, as these
    values have them, as the normal distribution allows: Newcombe's (2006, method 5) and, against
    one value, Wilson's of a share. Unlike the bootstrap's it has a width where all values of one
    sample are greater. NaN for an undefined effect.
    """
    limit = float(scipy.stats.norm.isf(alpha / 2)) ** 2

    def excess(value: float) -> float:
        variance = value * (1 - value) / m
        if not math.isnan(n):
            variance *= (
                1
                + ((m + n) / 2 - 1) * ((1 - value) / (2 - value) + value / (1 + value))
            ) / n
        return (effect - value) ** 2 - limit * variance

    if math.isnan(effect):
        return math.nan, math.nan
    low, high = 0.0, 1.0
    # From beside the effect, where the excess is below 0, whatever the effect.
    if effect > low:
        low = scipy.optimize.brentq(excess, effect + 1e-9 * (low - effect), low)
    if effect < high:
        high = scipy.optimize.brentq(excess, effect + 1e-9 * (high - effect), high)
    return low, high


def median_interval(values: ArrayLike, alpha: float = ALPHA) -> Interval:
    """The interval of a median, at a confidence of at least 1 - alpha, between two order
    statistics; NaN if there are too few values.
    """
    ordered = np.sort(np.asarray(values, float))
    # The first rank whose probability is not too small.
    rank = int(scipy.stats.binom.ppf(alpha / 2, ordered.size, 0.5))
    if rank:
        return (ordered[rank - 1], ordered[-rank])
    return (math.nan, math.nan)
