"""RQ2 for any set of algorithms: every pair, ranks over runs (Friedman), and the region of the objective space that the runs attain."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import moocore
import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.comparisons import ALPHA, compare_samples, reverse_effect
from safevar_sumo.analysis.research_questions.indicators import MORE_IS_BETTER, compute_indicators, defined_minimised_values
from safevar_sumo.analysis.research_questions.over_runs import correct_by_holm, run_mean_series
from safevar_sumo.analysis.words import number_of
from safevar_sumo.records import FloatArray

PAIR_COLUMNS = ["setting", "algorithm", "other", "metric", "p_value", "p_holm", "effect_size", "magnitude", "n1", "n2", "method"]
RANK_COLUMNS = ["setting", "metric", "algorithm", "mean_rank", "median", "runs", "statistic", "p_value", "p_holm", "critical_difference"]
SURFACE_PERCENTAGES = (50.0, 100.0)
"""An attainment surface is computed for each of these percentages of the runs, and for the percentage that one run is (the best of all)."""


def compare_pairs(case: Case) -> pd.DataFrame:
    """Compare every pair of algorithms by Mann-Whitney U, with one value per run: each indicator, and each metric's mean over solutions.

    Columns: `PAIR_COLUMNS`, where `setting` holds the case's name and `other` the other algorithm. `effect_size` is A12, oriented so that
    higher values mean that `algorithm` is better than `other`: a better front, more unsafe solutions. `p_holm` is `p_value` corrected by
    Holm's method for all pairs and metrics of this case. Undefined values are None.

    Raises
    ------
    UnanswerableError
        If there are no runs, or runs of only one algorithm.
    """
    samples, rows = _collect_samples(case, min_algorithms=2), list[dict[str, Any]]()
    for first, second in combinations(case.algorithms, 2):
        for metric, (more_is_better, by_algorithm) in samples.items():
            test = compare_samples(*(by_algorithm[name].dropna() for name in (first, second)))
            rows.append({"setting": case.name, "algorithm": first, "other": second, "metric": metric,
                         **(test if more_is_better else reverse_effect(test))._asdict()})
    for row, p in zip(rows, correct_by_holm([row["p_value"] for row in rows]), strict=True):
        row["p_holm"] = p
    return pd.DataFrame(rows, columns=PAIR_COLUMNS, dtype=object)


def rank_algorithms(case: Case) -> pd.DataFrame:
    """Mean ranks of the algorithms over runs, metric by metric, with Friedman's test.

    Runs with the same number form a block; a block in which an algorithm has no value is left out. Columns: `RANK_COLUMNS`, where
    `setting` holds the case's name. Rank 1 is the best, `runs` counts blocks, `statistic` and `p_value` are Friedman's, `p_holm` is
    corrected for all metrics of this case. Mean ranks that differ by less than `critical_difference` are not distinguished (Nemenyi's test
    at 0.01; Demsar 2006).

    Raises
    ------
    UnanswerableError
        If there are no runs, or fewer than three algorithms.
    """
    p_values, rows = dict[str, float | None](), list[dict[str, Any]]()
    for metric, (more_is_better, by_algorithm) in _collect_samples(case, min_algorithms=3).items():
        blocks = pd.DataFrame(by_algorithm).dropna()
        values = blocks.to_numpy(dtype=float)
        ranks_of_runs = scipy.stats.rankdata(-values if more_is_better else values, axis=1)
        statistic, p = _friedman(values)
        p_values[metric] = p
        rows += [{"setting": case.name, "metric": metric, "algorithm": name, "runs": len(blocks), "statistic": statistic, "p_value": p,
                  "mean_rank": float(ranks_of_runs[:, i].mean()) if len(blocks) else None,
                  "median": float(np.median(values[:, i])) if len(blocks) else None,
                  "critical_difference": critical_difference(len(blocks.columns), len(blocks)) if len(blocks) else None}
                 for i, name in enumerate(blocks.columns)]
    corrected_p_values = dict(zip(p_values, correct_by_holm(list(p_values.values())), strict=True))
    return pd.DataFrame([{**row, "p_holm": corrected_p_values[row["metric"]]} for row in rows], columns=RANK_COLUMNS, dtype=object)


def critical_difference(algorithm_count: int, run_count: int, alpha: float = ALPHA) -> float:
    """Least difference of mean ranks that the test distinguishes (Nemenyi 1963): q sqrt(k (k + 1) / (6 N)) for k algorithms and N runs."""
    q = float(scipy.stats.studentized_range.ppf(1 - alpha, algorithm_count, np.inf)) / np.sqrt(2)
    return float(q * np.sqrt(algorithm_count * (algorithm_count + 1) / (6 * run_count)))


def compute_attainment(case: Case) -> dict[str, dict[float, FloatArray]]:
    """Empirical attainment surfaces of the first two objectives, by algorithm and percentage of its runs.

    A surface is K points, shape (K, 2), in the objectives' units, sorted by the first objective. For each of its points, that percentage
    of the runs found a setting at least as good (Fonseca, Guerreiro, Lopez-Ibanez, Paquete 2011).

    Raises
    ------
    UnanswerableError
        If there are no runs with solutions.
    """
    surfaces: dict[str, dict[float, FloatArray]] = {}
    signs = np.array([objective.sign for objective in case.scoring.objectives[:2]])
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        fronts = [defined_minimised_values(case, solutions[solutions["run"] == run])[:, :2] for run in case.runs_of(algorithm)]
        fronts = [front for front in fronts if len(front)]
        if fronts:
            run_indices = np.repeat(np.arange(len(fronts)), [len(front) for front in fronts])
            percentages = sorted({100 / len(fronts), *SURFACE_PERCENTAGES})
            points = moocore.eaf(np.concatenate(fronts), run_indices, percentiles=percentages)
            surfaces[algorithm] = {
                percentage: (minimised := points[points[:, 2] == percentage, :2])[np.argsort(minimised[:, 0], kind="stable")] * signs
                for percentage in np.unique(points[:, 2]).tolist()}
    if not surfaces:
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    return surfaces


def _collect_samples(case: Case, *, min_algorithms: int) -> Mapping[str, tuple[bool, dict[str, pd.Series[float]]]]:
    """For each indicator and metric: whether more is better (a metric: more unsafe), and each algorithm's values by run."""
    case.require_runs()
    if len(case.algorithms) < min_algorithms:
        names = ", ".join(case.algorithms) or "none"
        raise UnanswerableError(case.name, f"has finished runs of {number_of(len(case.algorithms), 'algorithm')} ({names})",
                                f"results of {min_algorithms} algorithms or more")
    samples: dict[str, tuple[bool, dict[str, pd.Series[float]]]] = {}
    if len(case.solutions):
        indicators = compute_indicators(case).set_index(["algorithm", "run"])
        for name, more_is_better in MORE_IS_BETTER.items():
            samples[name] = more_is_better, {
                algorithm: indicators.loc[indicators.index.get_level_values(0) == algorithm, name].droplevel(0)
                for algorithm in case.algorithms}
    for metric in case.scoring.metrics:
        samples[metric.name] = metric.more_is_unsafe, {
            algorithm: run_mean_series(case, algorithm, metric) for algorithm in case.algorithms}
    return samples


def _friedman(values: FloatArray) -> tuple[float | None, float | None]:
    """Friedman's statistic and p-value of N runs of k algorithms, shape (N, k); 0 and 1 if all algorithms are equal, None if N < 2."""
    if len(values) < 2:
        return None, None
    if np.all(values == values[:, :1]):
        return 0.0, 1.0
    test = scipy.stats.friedmanchisquare(*values.T)
    return float(test.statistic), float(test.pvalue)
