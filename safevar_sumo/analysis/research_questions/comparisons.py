"""RQ1 and RQ2: algorithms against the original vehicle and against each other, over pooled solutions and over runs.

The paper pools the solutions of all runs and compares them with a second sample: the original's single value, repeated
once for each solution. Solutions of one run resemble each other, and a repeated value is no sample: p-values become too
small. Over runs, each run contributes one value, and Holm's method corrects for the number of tests.

In the frames, the column `setting` holds the case's name, and `method` the name of the test; undefined values are None.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import combinations

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.research_questions.case import NSGA2, Case, UnanswerableError, defined_solutions
from safevar_sumo.analysis.research_questions.statistics import (
    INDICATOR_TITLES,
    MORE_IS_BETTER,
    TwoSampleTest,
    compare_samples,
    compute_indicators,
    correct_by_holm,
    critical_difference,
    friedman_test,
    signed_rank_test,
)
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import MetricFacts
from safevar_sumo.records import JsonObject

TEST_COLUMNS = ["effect_size", "magnitude", "n1", "n2", "method"]
RQ1_COLUMNS = ["setting", "algorithm", "metric", "p_value", *TEST_COLUMNS, "mean", "original"]
RQ2_COLUMNS = ["setting", "baseline", "metric", "p_value", *TEST_COLUMNS]
RUNS_COLUMNS = {
    "RQ1": [
        *("setting", "algorithm", "metric", "p_value", "p_holm", "effect_size", "magnitude", "runs", "method"),
        *("mean", "original"),
    ],
    "RQ2": ["setting", "baseline", "metric", "p_value", "p_holm", *TEST_COLUMNS],
}
"""Columns of RQ1 and RQ2 over runs."""
PAIR_COLUMNS = ["setting", "algorithm", "other", "metric", "p_value", "p_holm", *TEST_COLUMNS]
RANK_COLUMNS = ["setting", "metric", "algorithm", "mean_rank", "median", "runs", "statistic", "p_value", "p_holm"]
RANK_COLUMNS += ["critical_difference"]

SampleFunction = Callable[[Case, str, MetricFacts], "pd.Series[float]"]
"""Returns an algorithm's values of a metric."""
Samples = Mapping[str, tuple[bool, Mapping[str, "pd.Series[float]"]]]
"""For each indicator and metric: whether larger values speak for an algorithm (a better front, or more unsafe
solutions), and each algorithm's values.
"""


def pooled_values(case: Case, algorithm: str, metric: MetricFacts) -> pd.Series[float]:
    """A metric's defined values over the solutions that count for it."""
    return defined_solutions(case.solutions_of(algorithm), metric)[metric.name].astype(float)


def run_means(case: Case, algorithm: str, metric: MetricFacts) -> pd.Series[float]:
    """The mean of a metric's defined values in each finished run that has some, by the run's number."""
    case.runs_of(algorithm)  # raises if there are none
    solutions = defined_solutions(case.solutions_of(algorithm), metric)
    by_run = solutions.groupby("run")[metric.name]
    return pd.Series({run: float(np.mean(values.to_numpy(dtype=float))) for run, values in by_run}, dtype=float)


def rq1(case: Case) -> pd.DataFrame:
    """Every algorithm's solutions against the original's value, repeated once for each solution, metric by metric.

    Columns: `RQ1_COLUMNS`. `effect_size` is A12, oriented so that smaller values mean that the algorithm's solutions
    are more unsafe; `mean` is the mean over the algorithm's solutions, `original` the original vehicle's value.

    Raises
    ------
    UnanswerableError
        If no run is finished.
    """
    rows = _rows_against_original(case, pooled_values, _against_repeated_original)
    return pd.DataFrame(rows, columns=RQ1_COLUMNS, dtype=object)


def _against_repeated_original(sample: pd.Series[float], original: float) -> TwoSampleTest:
    return compare_samples(sample, np.full(0 if np.isnan(original) else len(sample), original))


def _rows_against_original(
    case: Case, sample_of: SampleFunction, test: Callable[[pd.Series[float], float], TwoSampleTest]
) -> list[JsonObject]:
    case.require_solutions()
    rows = []
    for algorithm in case.algorithms:
        for metric in case.scoring.metrics:
            sample = sample_of(case, algorithm, metric)
            original = case.original[metric.name]
            # Below 0.5: the algorithm's solutions are more unsafe than the original.
            result = test(sample, original).reversed_if(metric.more_is_unsafe)
            rows.append(
                {
                    "setting": case.name,
                    "algorithm": algorithm,
                    "metric": metric.name,
                    **result._asdict(),
                    "runs": result.n1,
                    "mean": float(np.mean(sample.to_numpy())) if sample.size else None,
                    "original": None if np.isnan(original) else original,
                }
            )
    return rows


def rq2(case: Case) -> pd.DataFrame:
    """NSGA-II against every other algorithm: its runs' indicators, then its pooled solutions' metrics.

    Columns: `RQ2_COLUMNS`. `effect_size` is A12, oriented so that higher values mean that NSGA-II is better: a better
    front, more unsafe solutions. `n1` counts NSGA-II's values, `n2` the baseline's. Indicators of imported solutions,
    which belong to no run, are None.

    Raises
    ------
    UnanswerableError
        If NSGA-II is missing, or there is no other algorithm.
    """
    rows = _rows_of_pairs(case, nsga2_pairs(case), _samples(case, pooled_values))
    return pd.DataFrame(rows, columns=RQ2_COLUMNS, dtype=object)


def nsga2_pairs(case: Case) -> list[tuple[str, str]]:
    """NSGA-II with every other algorithm; raises `UnanswerableError` if NSGA-II is missing, or there is no other
    algorithm.
    """
    case.solutions_of(NSGA2)  # raises if there are none
    pairs = [(NSGA2, name) for name in case.algorithms if name != NSGA2]
    if not pairs:
        raise UnanswerableError(
            case.name, f"only {NSGA2} has finished runs", "results of another algorithm to compare with, such as rs"
        )
    return pairs


def _samples(case: Case, sample_of: SampleFunction) -> Samples:
    """The values of every indicator, which are empty for solutions that belong to no run, and of every metric."""
    indicators = pd.DataFrame()
    if case.has_runs and len(case.solutions):
        indicators = compute_indicators(case)
    empty = pd.Series(dtype=float)
    by_algorithm = {str(name): rows.droplevel("algorithm") for name, rows in indicators.groupby(level=0)}
    return {
        **{
            name: (
                more_is_better,
                {
                    algorithm: by_algorithm[algorithm][name] if algorithm in by_algorithm else empty
                    for algorithm in case.algorithms
                },
            )
            for name, more_is_better in MORE_IS_BETTER.items()
        },
        **{
            metric.name: (
                metric.more_is_unsafe,
                {algorithm: sample_of(case, algorithm, metric) for algorithm in case.algorithms},
            )
            for metric in case.scoring.metrics
        },
    }


def _rows_of_pairs(case: Case, pairs: Iterable[tuple[str, str]], samples: Samples) -> list[JsonObject]:
    """A row for each pair and metric; the second algorithm is both its `other` and its `baseline`; frames take the
    column that they list.
    """
    return [
        {
            "setting": case.name,
            "algorithm": first,
            "other": second,
            "baseline": second,
            "metric": metric,
            # Above 0.5: the first algorithm is better.
            **compare_samples(values[first], values[second]).reversed_if(not more_is_better)._asdict(),
        }
        for first, second in pairs
        for metric, (more_is_better, values) in samples.items()
    ]


def compare_over_runs(case: Case) -> dict[str, pd.DataFrame]:
    """The frames of `rq1_runs` and `rq2_runs` by question, RQ1 and RQ2; RQ2 is missing if it has no answer.

    Raises
    ------
    UnanswerableError
        If the solutions belong to no run, or no run is finished.
    """
    rows = {"RQ1": _rows_against_original(case, run_means, signed_rank_test)}
    if NSGA2 in case.algorithms and len(case.algorithms) > 1:
        rows["RQ2"] = _rows_of_pairs(case, nsga2_pairs(case), _samples(case, run_means))
    _add_holm([row for rows_of_question in rows.values() for row in rows_of_question])
    return {name: pd.DataFrame(rows[name], columns=RUNS_COLUMNS[name], dtype=object) for name in rows}


def _add_holm(rows: list[JsonObject]) -> list[JsonObject]:
    """Add `p_holm` to the rows, corrected as one family."""
    for row, p in zip(rows, correct_by_holm([row["p_value"] for row in rows]), strict=True):
        row["p_holm"] = p
    return rows


def rq1_runs(case: Case) -> pd.DataFrame:
    """Every algorithm's run means against the original's value, metric by metric: Wilcoxon's signed-rank test.

    Columns: `RUNS_COLUMNS["RQ1"]`. `effect_size` is the share of runs whose mean is safer than the original's value,
    plus half the share of equal ones (A12 against one value): below 0.5 the runs are less safe. `mean` is the mean of
    the run means. `p_holm` is `p_value` corrected by Holm's method for all tests of RQ1 and RQ2 of this case.

    Raises
    ------
    UnanswerableError
        If the solutions belong to no run, or no run is finished.
    """
    return compare_over_runs(case)["RQ1"]


def rq2_runs(case: Case) -> pd.DataFrame:
    """Compare NSGA-II with every other algorithm by Mann-Whitney U, with one value per run: indicators, and metrics'
    means over solutions.

    Columns: `RUNS_COLUMNS["RQ2"]`. `effect_size` is A12, oriented as in `rq2`; `n1` and `n2` count runs; `p_holm` is
    defined as in `rq1_runs`.

    Raises
    ------
    UnanswerableError
        If the solutions belong to no run, NSGA-II is missing, or there is no other algorithm.
    """
    frames = compare_over_runs(case)
    nsga2_pairs(case)  # raises if RQ2 has no answer
    return frames["RQ2"]


def compare_pairs(case: Case) -> pd.DataFrame:
    """Compare every pair of algorithms by Mann-Whitney U, with one value per run: each indicator, and each metric's
    mean over solutions.

    Columns: `PAIR_COLUMNS`, where `other` is the other algorithm. `effect_size` is A12, oriented so that higher values
    mean that `algorithm` is better than `other`: a better front, more unsafe solutions. `p_holm` is `p_value` corrected
    by Holm's method for all pairs and metrics of this case.

    Raises
    ------
    UnanswerableError
        If there are no runs, or runs of only one algorithm.
    """
    samples = _samples_over_runs(case, 2)
    rows = _add_holm(_rows_of_pairs(case, combinations(case.algorithms, 2), samples))
    return pd.DataFrame(rows, columns=PAIR_COLUMNS, dtype=object)


def rank_algorithms(case: Case) -> pd.DataFrame:
    """Mean ranks of the algorithms over runs, metric by metric, with Friedman's test.

    Runs with the same number form a block; a block in which an algorithm has no value is left out. Columns:
    `RANK_COLUMNS`. Rank 1 is the best, `runs` counts blocks, `statistic` and `p_value` are Friedman's, `p_holm` is
    corrected for all metrics of this case. Mean ranks that differ by less than `critical_difference` are not
    distinguished (Nemenyi's test at 0.01; Demsar 2006).

    Raises
    ------
    UnanswerableError
        If there are no runs, or fewer than three algorithms.
    """
    tests = dict[str, JsonObject]()
    rows = list[JsonObject]()
    for metric, (more_is_better, by_algorithm) in _samples_over_runs(case, 3).items():
        blocks = pd.DataFrame(by_algorithm).dropna()
        values = blocks.to_numpy(dtype=float)
        ranks = scipy.stats.rankdata(-values if more_is_better else values, axis=1)
        statistic, p = friedman_test(values)
        tests[metric] = {"statistic": statistic, "p_value": p}
        rows += [
            {
                "setting": case.name,
                "metric": metric,
                "algorithm": name,
                "runs": len(blocks),
                "mean_rank": float(ranks[:, i].mean()) if len(blocks) else None,
                "median": float(np.median(values[:, i])) if len(blocks) else None,
                "critical_difference": critical_difference(len(blocks.columns), len(blocks)) if len(blocks) else None,
            }
            for i, name in enumerate(blocks.columns)
        ]
    _add_holm(list(tests.values()))
    return pd.DataFrame([row | tests[row["metric"]] for row in rows], columns=RANK_COLUMNS, dtype=object)


def _samples_over_runs(case: Case, min_algorithms: int) -> Samples:
    """The samples over runs of at least so many algorithms; raises `UnanswerableError` if there are fewer."""
    if case.has_runs and len(case.algorithms) < min_algorithms:
        names = ", ".join(case.algorithms) or "none"
        raise UnanswerableError(
            case.name,
            f"has finished runs of {number_of(len(case.algorithms), 'algorithm')} ({names})",
            f"results of {min_algorithms} algorithms or more",
        )
    return _samples(case, run_means)


def titles_of(metrics: Iterable[MetricFacts]) -> dict[str, str]:
    """Titles of metrics and quality indicators in tables, by name."""
    return {**INDICATOR_TITLES, **{metric.name: metric.title for metric in metrics}}
