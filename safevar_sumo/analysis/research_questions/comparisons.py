"""Comparison of two samples: Mann-Whitney U, and the size of the difference (docs/method.md, section 7).

In the frames, the column `setting` holds the case's name, and `method` the name of the test.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.analysis.research_questions.case import NSGA2, Case, UnanswerableError, defined_values
from safevar_sumo.analysis.research_questions.indicators import MORE_IS_BETTER, compute_indicators
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import MetricFacts
from safevar_sumo.records import FloatArray

ALPHA = 0.01
"""A p-value below this level is significant."""
EXACT_SAMPLE_SIZE = 8
"""Without ties, the p-value is exact if one sample has at most this many values; otherwise it is a normal approximation."""
EXACT_TEST = "Mann-Whitney U, two-sided, exact"
ASYMPTOTIC_TEST = "Mann-Whitney U, two-sided, normal approximation with corrections for ties and continuity"
MAGNITUDES = ((0.714, "large"), (0.638, "medium"), (0.556, "small"))
"""Kitchenham's magnitudes; each holds from this value of max(A12, 1 - A12) on."""
NOTABLE_MAGNITUDES = ("medium", "large")


class TwoSampleTest(NamedTuple):
    """Comparison of two samples X and Y; None where a sample is empty.

    `effect_size` is Vargha-Delaney's A12 = P(X > Y) + 0.5 P(X = Y), `n1` and `n2` the samples' sizes.
    """

    p_value: float | None
    effect_size: float | None
    magnitude: str | None
    n1: int
    n2: int
    method: str | None


def compare_samples(x: ArrayLike, y: ArrayLike) -> TwoSampleTest:
    """Compare two samples by U test and effect size.

    Raises
    ------
    InputError
        If a value is NaN.
    """
    first, second = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if np.isnan(first).any() or np.isnan(second).any():
        raise InputError("Mann-Whitney U", "a value is NaN", "samples without undefined values")
    if not first.size or not second.size:
        return TwoSampleTest(p_value=None, effect_size=None, magnitude=None, n1=first.size, n2=second.size, method=None)
    pooled = np.concatenate([first, second])
    is_exact = min(first.size, second.size) <= EXACT_SAMPLE_SIZE and np.unique(pooled).size == pooled.size
    test = scipy.stats.mannwhitneyu(first, second, alternative="two-sided", method="exact" if is_exact else "asymptotic")
    a12 = float(test.statistic) / (first.size * second.size)
    return TwoSampleTest(float(test.pvalue), a12, magnitude_of(a12), first.size, second.size, EXACT_TEST if is_exact else ASYMPTOTIC_TEST)


def magnitude_of(effect_size: float) -> str:
    """The magnitude of an effect size, by Kitchenham's intervals."""
    folded_effect = round(max(effect_size, 1 - effect_size), 12)
    return next((name for limit, name in MAGNITUDES if folded_effect >= limit), "negligible")


RQ1_COLUMNS = ["setting", "algorithm", "metric", "p_value", "effect_size", "magnitude", "n1", "n2", "method", "mean", "original"]


def rq1(case: Case) -> pd.DataFrame:
    """Every algorithm's solutions against the original's value, repeated once for each solution, metric by metric.

    Columns: `RQ1_COLUMNS`. `effect_size` is A12, oriented so that smaller values mean that the algorithm's solutions are
    more unsafe; `mean` is the mean over the algorithm's solutions, `original` the original vehicle's value. Undefined values are None.

    Raises
    ------
    UnanswerableError
        If no run is finished.
    """
    case.require_solutions()
    rows = rq1_rows(case, lambda algorithm, metric: defined_values(case.solutions_of(algorithm), metric),
                    lambda sample, original: compare_samples(sample, np.full(0 if np.isnan(original) else len(sample), original)))
    return pd.DataFrame(rows, columns=RQ1_COLUMNS, dtype=object)


SampleFunction = Callable[[str, MetricFacts], FloatArray]
"""Returns an algorithm's N values of a metric, shape (N,)."""


def rq1_rows(case: Case, sample_of: SampleFunction, test: Callable[[FloatArray, float], TwoSampleTest]) -> list[dict[str, Any]]:
    """A row for each algorithm and metric: the test of its sample against the original's value, oriented as in `rq1`."""
    rows = []
    for algorithm in case.algorithms:
        for metric in case.scoring.metrics:
            sample, original = sample_of(algorithm, metric), case.original[metric.name]
            comparison = test(sample, original)
            rows.append({"setting": case.name, "algorithm": algorithm, "metric": metric.name,
                         **(reverse_effect(comparison) if metric.more_is_unsafe else comparison)._asdict(),
                         "mean": float(np.mean(sample)) if sample.size else None, "original": None if np.isnan(original) else original})
    return rows


def reverse_effect(test: TwoSampleTest) -> TwoSampleTest:
    """The same test with the effect size of the second sample against the first, 1 - A12."""
    effect = None if test.effect_size is None else 1 - test.effect_size
    return test if effect is None else test._replace(effect_size=effect, magnitude=magnitude_of(effect))


RQ2_COLUMNS = ["setting", "baseline", "metric", "p_value", "effect_size", "magnitude", "n1", "n2", "method"]


def rq2(case: Case) -> pd.DataFrame:
    """NSGA-II against every other algorithm: its runs' indicators, then its pooled solutions' metrics.

    Columns: `RQ2_COLUMNS`. `effect_size` is A12, oriented so that higher values mean that NSGA-II is better: a better front,
    more unsafe solutions. `n1` counts NSGA-II's values, `n2` the baseline's. Undefined values are None, as are the
    indicators of imported solutions, which belong to no run.

    Raises
    ------
    UnanswerableError
        If NSGA-II is missing, or there is no other algorithm.
    """
    require_rq2_algorithms(case)
    rows = rq2_rows(case, lambda algorithm, metric: defined_values(case.solutions_of(algorithm), metric))
    return pd.DataFrame(rows, columns=RQ2_COLUMNS, dtype=object)


def require_rq2_algorithms(case: Case) -> None:
    """Raise `UnanswerableError` if NSGA-II is missing, or there is no other algorithm."""
    case.solutions_of(NSGA2)  # raises if there are none
    if all(name == NSGA2 for name in case.algorithms):
        raise UnanswerableError(case.name, f"only {NSGA2} has finished runs", "results of another algorithm to compare with, such as rs")


def rq2_rows(case: Case, sample_of: SampleFunction) -> list[dict[str, Any]]:
    """For every other algorithm, a row for each indicator and metric: NSGA-II's values against that algorithm's, oriented as in `rq2`."""
    indicators = compute_indicators(case) if case.has_runs and len(case.solutions) else None
    rows = []
    for baseline in (name for name in case.algorithms if name != NSGA2):
        pair = (NSGA2, baseline)
        tests = [(name, not more_is_better, compare_samples(*(
            [] if indicators is None else indicators.loc[indicators["algorithm"] == algorithm, name] for algorithm in pair)))
            for name, more_is_better in MORE_IS_BETTER.items()]
        tests += [(metric.name, not metric.more_is_unsafe, compare_samples(*(sample_of(algorithm, metric) for algorithm in pair)))
                  for metric in case.scoring.metrics]
        rows += [{"setting": case.name, "baseline": baseline, "metric": name,
                  **(reverse_effect(test) if is_reversed else test)._asdict()} for name, is_reversed, test in tests]
    return rows
