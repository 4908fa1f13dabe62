"""Statistical tests: Mann-Whitney U, signed ranks, Friedman, effect sizes, and corrections for many tests
(docs/method.md, section 7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray

ALPHA = 0.01
"""A p-value below this level is significant."""
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
    """Comparison of two samples X and Y; None where a sample is empty.

    `effect_size` is Vargha-Delaney's A12 = P(X > Y) + 0.5 P(X = Y), `n1` and `n2` the samples' sizes, `method` the name
    of the test.
    """

    p_value: float | None
    effect_size: float | None
    magnitude: str | None
    n1: int
    n2: int
    method: str | None

    def reversed_if(self, condition: bool) -> TwoSampleTest:
        """The test itself, or with the effect size of the second sample against the first, 1 - A12."""
        if self.effect_size is None or not condition:
            return self
        return self._replace(effect_size=1 - self.effect_size, magnitude=magnitude_of(1 - self.effect_size))


def compare_samples(x: ArrayLike, y: ArrayLike) -> TwoSampleTest:
    """Compare two samples by U test and effect size.

    Raises
    ------
    InputError
        If a value is NaN.
    """
    first, second = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    pooled = np.concatenate([first, second])
    if np.isnan(pooled).any():
        raise InputError("Mann-Whitney U", "a value is NaN", "samples without undefined values")
    if not first.size or not second.size:
        return TwoSampleTest(None, None, None, first.size, second.size, None)
    is_exact = min(first.size, second.size) <= EXACT_SAMPLE_SIZE and np.unique(pooled).size == pooled.size
    test = scipy.stats.mannwhitneyu(
        first, second, alternative="two-sided", method="exact" if is_exact else "asymptotic"
    )
    a12 = float(test.statistic) / (first.size * second.size)
    return TwoSampleTest(
        float(test.pvalue), a12, magnitude_of(a12), first.size, second.size, EXACT_TEST if is_exact else ASYMPTOTIC_TEST
    )


def magnitude_of(effect_size: float) -> str:
    """The magnitude of an effect size, by Kitchenham's intervals."""
    folded_effect = round(max(effect_size, 1 - effect_size), 12)
    return next((name for limit, name in MAGNITUDES if folded_effect >= limit), "negligible")


def signed_rank_test(sample: ArrayLike, value: float) -> TwoSampleTest:
    """Compare independent values, shape (N,), with one value: Wilcoxon's test, and the share of greater values (A12).

    The test drops values equal to `value` (as Wilcoxon did); the effect size counts them by half.
    """
    differences = np.asarray(sample, dtype=float) - value
    if not differences.size or np.isnan(value):
        return TwoSampleTest(None, None, None, differences.size, 0, None)
    distances = np.abs(differences[differences != 0])
    effect = float(np.mean(differences > 0) + np.mean(differences == 0) / 2)
    is_exact = not distances.size or (np.unique(distances).size == differences.size <= MAX_EXACT_RUNS)
    p = (
        float(
            scipy.stats.wilcoxon(
                differences, alternative="two-sided", correction=not is_exact, method="exact" if is_exact else "approx"
            ).pvalue
        )
        if distances.size
        else 1.0
    )
    return TwoSampleTest(
        p, effect, magnitude_of(effect), differences.size, 1, EXACT_SIGNED_TEST if is_exact else ASYMPTOTIC_SIGNED_TEST
    )


def fewest_runs(question: str) -> int:
    """Smallest number of runs with which a test of this question can be significant before any correction.

    The smallest two-sided p-value of n runs is 2 / 2^n by the signed-rank test of RQ1, and 2 / C(2n, n) by the U test
    of RQ2.
    """
    return next(n for n in range(1, 100) if 2 / (2**n if question == "RQ1" else math.comb(2 * n, n)) < ALPHA)


def correct_by_holm(p_values: Sequence[float | None]) -> list[float | None]:
    """P-values corrected by Holm's step-down method (Holm 1979); None stays None and does not count as a test."""
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected_p_values, maximum = list(p_values), 0.0
    for rank, (p, index) in enumerate(order):
        maximum = max(maximum, min(1.0, p * (len(order) - rank)))
        corrected_p_values[index] = maximum
    return corrected_p_values


def friedman_test(values: FloatArray) -> tuple[float | None, float | None]:
    """Friedman's statistic and p-value of N runs of k algorithms, shape (N, k); 0 and 1 if all algorithms are equal,
    None if N < 2.
    """
    if len(values) < 2:
        return None, None
    if np.all(values == values[:, :1]):
        return 0.0, 1.0
    test = scipy.stats.friedmanchisquare(*values.T)
    return float(test.statistic), float(test.pvalue)


def critical_difference(algorithm_count: int, run_count: int, alpha: float = ALPHA) -> float:
    """Least difference of mean ranks that the test distinguishes (Nemenyi 1963): q sqrt(k (k + 1) / (6 N)) for k
    algorithms and N runs.
    """
    q = scipy.stats.studentized_range.ppf(1 - alpha, algorithm_count, np.inf) / np.sqrt(2)
    return float(q * np.sqrt(algorithm_count * (algorithm_count + 1) / (6 * run_count)))
