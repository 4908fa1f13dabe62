"""Statistics of runs (docs/method.md, section 7): tests (Mann-Whitney U, signed ranks, Friedman), effect sizes and
corrections for many tests; then the quality of a run's front: IGD on the objectives in their units, IGD+ and
hypervolume on normalised ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import moocore
import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from safevar_sumo.analysis.case import Case, UnanswerableError
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

    def reversed_if(self, condition: bool) -> TwoSampleTest:
        """The test itself, or with the effect size of the second sample against the first, 1 - A12."""
        if not condition or not self.method:
            return self
        return self._replace(effect_size=1 - self.effect_size, magnitude=magnitude_of(1 - self.effect_size))


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
    folded_effect = round(max(effect_size, 1 - effect_size), 12)
    return next((name for limit, name in MAGNITUDES if folded_effect >= limit), "negligible")


def signed_rank_test(sample: ArrayLike, value: float) -> TwoSampleTest:
    """Compare independent values, shape (N,), with one value: Wilcoxon's test, and the share of greater values (A12).

    The test drops values equal to `value` (as Wilcoxon did); the effect size counts them by half.
    """
    differences = np.asarray(sample, dtype=float) - value
    if not differences.size or np.isnan(value):
        return TwoSampleTest(np.nan, np.nan, None, differences.size, 0, None)
    effect = float(np.mean(differences > 0) + np.mean(differences == 0) / 2)
    is_exact = differences.size <= MAX_EXACT_RUNS and has_distinct_values([0.0, *np.abs(differences)])
    name, method = (EXACT_SIGNED_TEST, "exact") if is_exact else (ASYMPTOTIC_SIGNED_TEST, "approx")
    if not differences.any():
        name, p = EXACT_SIGNED_TEST, 1.0
    else:
        p = float(scipy.stats.wilcoxon(differences, correction=not is_exact, method=method).pvalue)
    return TwoSampleTest(p, effect, magnitude_of(effect), differences.size, 1, name)


def fewest_runs(question: str) -> int:
    """Smallest number of runs with which a test of this question can be significant before any correction.

    The smallest two-sided p-value of n runs is 2 / 2^n by the signed-rank test of RQ1, and 2 / C(2n, n) by the U test
    of RQ2.
    """
    return next(n for n in range(1, 100) if 2 / (2**n if question == "RQ1" else math.comb(2 * n, n)) < ALPHA)


def correct_by_holm(p_values: Iterable[float]) -> FloatArray:
    """P-values corrected by Holm's step-down method (Holm 1979); NaN stays NaN and does not count as a test."""
    values = pd.Series(list(p_values), dtype=float)
    ascending = values.dropna().sort_values()
    corrected = (ascending * np.arange(len(ascending), 0, -1)).clip(upper=1.0).cummax()
    return np.asarray(corrected.reindex(values.index), dtype=float)


def friedman_test(values: FloatArray) -> tuple[float, float]:
    """Friedman's statistic and p-value of N runs of k algorithms, shape (N, k); 0 and 1 if all algorithms are equal,
    NaN if N < 2.
    """
    if len(values) < 2:
        return np.nan, np.nan
    if not np.ptp(values, axis=1).any():
        return 0.0, 1.0
    test = scipy.stats.friedmanchisquare(*values.T)
    return float(test.statistic), float(test.pvalue)


def critical_difference(algorithm_count: int, run_count: int, alpha: float = ALPHA) -> float:
    """Least difference of mean ranks that the test distinguishes (Nemenyi 1963): q sqrt(k (k + 1) / (6 N)) for k
    algorithms and N runs; NaN without runs.
    """
    if not run_count:
        return np.nan
    q = scipy.stats.studentized_range.ppf(1 - alpha, algorithm_count, np.inf) / np.sqrt(2)
    return float(q * np.sqrt(algorithm_count * (algorithm_count + 1) / (6 * run_count)))


MORE_IS_BETTER = {"igd": False, "igd_plus": False, "hypervolume": True}
INDICATOR_TITLES = {"igd": "IGD", "igd_plus": "IGD+", "hypervolume": "HV"}
REFERENCE_COORDINATE = 1.1
"""Each coordinate of the hypervolume's reference point for objectives normalised to 0..1: a tenth beyond the nadir."""
SURFACE_PERCENTAGES = (50.0, 100.0)
"""An attainment surface is computed for each of these percentages of the runs, and for the percentage that one run is
(the best of all)."""
CURVE_POINTS = 50
"""Maximum number of points of a run's curve."""


def nondominated_points(points: FloatArray) -> FloatArray:
    """The distinct non-dominated points for minimisation, with shape (points, objectives)."""
    return np.asarray(moocore.filter_dominated(points))


def hypervolume(front: FloatArray) -> float:
    """The volume between `front` and the reference point."""
    return float(moocore.hypervolume(front, ref=np.full(front.shape[1], REFERENCE_COORDINATE)))


def normalised(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Points on the scale from the best (0) to the worst value (1) of each objective in a reference front.

    The scale's width is 1 if both are equal.
    """
    ideal, nadir = reference.min(axis=0), reference.max(axis=0)
    return np.asarray((points - ideal) / np.where(nadir > ideal, nadir - ideal, 1.0))


def minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The objectives' values, smaller being better, shape (rows, objectives); NaN where undefined."""
    signs = [objective.sign for objective in case.scoring.objectives]
    return frame[[objective.name for objective in case.scoring.objectives]].to_numpy(dtype=float) * signs


def defined_minimised_values(case: Case, frame: pd.DataFrame) -> FloatArray:
    """The `minimised_values` of the rows in which all objectives are defined."""
    points = minimised_values(case, frame)
    return points[np.isfinite(points).all(axis=1)]


def reference_front(case: Case) -> FloatArray:
    """The non-dominated union of the results of all runs of all algorithms.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    points = defined_minimised_values(case, case.solutions)
    if not len(points):
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    return nondominated_points(points)


def compute_indicators(case: Case) -> pd.DataFrame:
    """IGD, IGD+ and hypervolume of every finished run that has solutions; index algorithm and run, a column for each
    indicator.

    IGD is the mean Euclidean distance from each point of the reference front to the run's nearest point; IGD+ counts
    only the objectives in which this point is worse.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    reference = reference_front(case)
    scaled_reference, rows = normalised(reference, reference), {}
    for run, group in _frames_of_runs(case, case.solutions):
        if len(points := defined_minimised_values(case, group)):
            scaled = normalised(points, reference)
            distances = moocore.igd(points, ref=reference), moocore.igd_plus(scaled, ref=scaled_reference)
            rows[run] = *map(float, distances), hypervolume(scaled)
    index = pd.MultiIndex.from_tuples(rows, names=["algorithm", "run"])
    return pd.DataFrame(rows.values(), index, list(MORE_IS_BETTER))


def _frames_of_runs(case: Case, frame: pd.DataFrame) -> Iterator[tuple[tuple[str, int], pd.DataFrame]]:
    """The finished runs that have rows, each with its rows, in the study's order of algorithms."""
    groups = dict(list(frame.groupby(["algorithm", "run"])))
    runs = [(algorithm, run) for algorithm in case.algorithms for run in case.runs_of(algorithm)]
    yield from ((run, groups[run]) for run in runs if run in groups)


def compute_convergence(case: Case) -> pd.DataFrame:
    """The hypervolume of each run's settings after a number of evaluations; columns algorithm, run, evaluations,
    hypervolume.

    A run that ended early keeps its last hypervolume. The hypervolume is 0 as long as no setting dominates the
    reference point.

    Raises
    ------
    UnanswerableError
        If there are no runs or no solutions.
    """
    reference, search, frames = reference_front(case), case.study.search, list[pd.DataFrame]()
    counts = np.unique(
        np.linspace(min(search.population, search.evaluations), search.evaluations, CURVE_POINTS, dtype=int)
    )
    for (algorithm, run), group in _frames_of_runs(case, case.evaluations):
        points = normalised(minimised_values(case, group), reference)
        is_defined = np.isfinite(points).all(axis=1)
        ends = np.searchsorted(group["evaluation"].to_numpy()[is_defined], counts)
        front, volumes = points[:0], []
        for new_points in np.split(points[is_defined], ends)[:-1]:
            front = nondominated_points(np.concatenate([front, new_points]))
            volumes.append(hypervolume(front))
        frames.append(pd.DataFrame({"algorithm": algorithm, "run": run, "evaluations": counts, "hypervolume": volumes}))
    if not frames:
        raise UnanswerableError(case.name, "has no evaluations", "results with the journals of their runs")
    return pd.concat(frames, ignore_index=True)


def compute_attainment(case: Case) -> dict[str, dict[float, FloatArray]]:
    """Empirical attainment surfaces of the first two objectives, by algorithm and percentage of its runs.

    A surface is K points, shape (K, 2), in the objectives' units, sorted by the first objective. For each of its
    points, that percentage of the runs found a setting at least as good (Fonseca, Guerreiro, Lopez-Ibanez, Paquete
    2011).

    Raises
    ------
    UnanswerableError
        If there are no runs with solutions.
    """
    surfaces: dict[str, dict[float, FloatArray]] = {}
    signs = np.array([objective.sign for objective in case.scoring.objectives[:2]])
    for algorithm in case.algorithms:
        case.runs_of(algorithm)  # raises if there are none
        solutions = case.solutions_of(algorithm)
        points = minimised_values(case, solutions)
        is_defined = np.isfinite(points).all(axis=1)
        if is_defined.any():
            runs = solutions["run"].to_numpy(dtype=int)[is_defined]
            percentages = sorted({100 / np.unique(runs).size, *SURFACE_PERCENTAGES})
            surface = moocore.eaf(points[is_defined, :2], runs, percentiles=percentages)
            surface = surface[np.argsort(surface[:, 0], kind="stable")]
            surfaces[algorithm] = {
                percentage: surface[surface[:, 2] == percentage, :2] * signs
                for percentage in np.unique(surface[:, 2]).tolist()
            }
    if not surfaces:
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    return surfaces
