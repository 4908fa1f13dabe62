"""Statistics of samples and runs (docs/method.md, section 7): Mann-Whitney U, Wilcoxon's signed
ranks, effect sizes, medians, their intervals, and Holm's correction for many tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import Decimal
from itertools import count
from operator import sub
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.questions.sampling import Interval
from safevar_sumo.records import FloatArray

ALPHA = 0.01
"""Default level of significance: a smaller p-value is significant. Intervals have the confidence 1
- ALPHA.
"""
EXACT_SAMPLE_SIZE = 8
"""Number of values up to which the p-value of the U test is exact, if the smaller sample has no
more values, and no values are tied. Otherwise the p-value is a normal approximation.
"""
MAX_EXACT_RUNS = 50
"""Number of runs up to which the signed-rank test is exact, if no differences are tied or zero."""
RANKED_DIGITS = 12
"""Values are rounded to this number of significant digits before they are ranked. Otherwise
rounding errors would distinguish values that are ties.
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
"""Kitchenham's magnitudes of effects. Each begins at its value of max(A12, 1 - A12)."""


def fewest_runs(question: str, alpha: float = ALPHA, tests: int = 1) -> int:
    """The smallest number of runs of every algorithm with which a test of RQ1 or RQ2 can be
    significant, after Holm's correction for `tests` tests.
    """
    return next(n for n in count(1) if can_be_significant(question, n, n, alpha, tests))


def can_be_significant(
    question: str, m: int, n: int, alpha: float = ALPHA, tests: int = 1
) -> bool:
    """Whether a test can be significant after Holm's correction for `tests` tests. A test of RQ1
    has m runs. A test of RQ2 has m runs, against n runs of another algorithm.

    By the exact distribution, the smallest two-sided p-value of RQ1's signed-rank test is 2 / 2^m.
    For RQ2's U test it is 2 / C(m + n, n). Holm multiplies the smallest p-value by the number of
    tests.
    """
    orders = 2**m if question == "RQ1" else math.comb(m + n, n)
    return 2 * max(tests, 1) / orders < alpha


class TwoSampleTest(NamedTuple):
    """The comparison of two samples X and Y. If a sample is empty, the results are NaN or None.

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
        """The same test, but with an effect size that is above 0.5 if X is better: A12, or 1 - A12
        if smaller values are better.
        """
        if larger_is_better:
            return self
        return self._replace(effect_size=1 - self.effect_size)


def compare_samples(x: ArrayLike, y: ArrayLike) -> TwoSampleTest:
    """Compare two samples by the Mann-Whitney U test and A12. No value may be undefined."""
    sample = rounded_to_rank(x)
    baseline = rounded_to_rank(y)
    n1 = sample.size
    n2 = baseline.size
    if not n1 or not n2:
        return TwoSampleTest(np.nan, np.nan, None, n1, n2, None)
    name, method = ASYMPTOTIC_TEST, "asymptotic"
    is_small = min(n1, n2) <= EXACT_SAMPLE_SIZE
    if is_small and has_distinct_values([*sample, *baseline]):
        name, method = EXACT_TEST, "exact"
    test = scipy.stats.mannwhitneyu(sample, baseline, method=method, nan_policy="raise")
    a12 = float(test.statistic) / (n1 * n2)
    return TwoSampleTest(float(test.pvalue), a12, magnitude_of(a12), n1, n2, name)


def rounded_to_rank(values: ArrayLike) -> FloatArray:
    """Values of any shape as an array of one dimension, rounded to `RANKED_DIGITS` digits."""
    return np.array(_decimals(values), float)


def _decimals(values: ArrayLike) -> list[Decimal]:
    """Values of any shape as decimal numbers with `RANKED_DIGITS` significant digits."""
    return [
        Decimal(f"{value:.{RANKED_DIGITS}g}") for value in np.ravel(values).tolist()
    ]


def has_distinct_values(values: ArrayLike) -> bool:
    """Whether no two values are equal."""
    return np.unique(values).size == np.size(values)


def magnitude_of(effect_size: float) -> str:
    """The magnitude of an effect size, by Kitchenham's intervals."""
    # 1 - 0.286 must be a large effect, as 0.714 is: the rounding error is removed first.
    folded_effect = round(max(effect_size, 1 - effect_size), 12)
    return next(
        (name for limit, name in MAGNITUDES if folded_effect >= limit), "negligible"
    )


def signed_rank_test(x: ArrayLike, y: ArrayLike = 0.0) -> TwoSampleTest:
    """Compare N pairs by Wilcoxon's signed-rank test. `x` has shape (N,); `y` has the same shape,
    or is one value for all pairs. The effect size is the share of pairs in which x is greater.

    The test drops differences of 0, as Wilcoxon did. The effect size counts them by half.
    """
    # Differences of decimal numbers have no rounding errors.
    baselines = _decimals(np.broadcast_to(y, np.shape(x)))
    differences = np.array(list(map(sub, _decimals(x), baselines)), float)

    if not differences.size or np.isnan(differences).any():
        return TwoSampleTest(np.nan, np.nan, None, differences.size, 0, None)

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
    """The interval of an effect size A12 at the confidence 1 - alpha; NaN for an undefined effect.
    The effect size compares m values with n values or, if n is NaN, with a single value.

    The interval holds all values A for which the effect is at most z standard errors away from A.
    The standard error is that of A, and z is the quantile of the normal distribution. This is
    Newcombe's interval (2006, method 5); with a single value it is Wilson's interval of a share. A
    bootstrap interval would have no width if all values of a sample are greater; this interval has
    one.
    """
    limit = float(scipy.stats.norm.isf(alpha / 2)) ** 2

    def excess(value: float) -> float:
        """The squared distance of `value` from the effect, less its allowed square: 0 at an end of
        the interval.
        """
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
    # The search for a root begins beside the effect, where the excess is below 0 for every effect.
    if effect > low:
        low = scipy.optimize.brentq(excess, effect + 1e-9 * (low - effect), low)
    if effect < high:
        high = scipy.optimize.brentq(excess, effect + 1e-9 * (high - effect), high)
    return low, high


def median_interval(values: ArrayLike, alpha: float) -> Interval:
    """The interval of a median at a confidence of at least 1 - alpha. Its ends are two of the
    ordered values; NaN if there are too few values.
    """
    ordered = np.sort(np.asarray(values, float))
    # The number of values below the median is binomial. The rank leaves out at most alpha / 2 on
    # each side.
    rank = int(scipy.stats.binom.ppf(alpha / 2, ordered.size, 0.5))
    if rank:
        return (ordered[rank - 1], ordered[-rank])
    return (math.nan, math.nan)
