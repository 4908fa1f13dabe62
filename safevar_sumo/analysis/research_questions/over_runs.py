"""RQ1 and RQ2 over runs: one mean for each run, so that a test's values are independent; Holm's correction for the number of tests.

The paper pools the solutions of all runs and compares them with a second sample: the original's single value, repeated once for each
solution. Solutions of one run resemble each other, and a repeated value is no sample: p-values become too small. Here each run
contributes one value.

In the frames, the column `setting` holds the case's name, and `method` the name of the test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, NSGA2, Case, UnanswerableError, solutions_for_metric
from safevar_sumo.analysis.research_questions.comparisons import (
    ALPHA,
    TwoSampleTest,
    magnitude_of,
    require_rq2_algorithms,
    rq1,
    rq1_rows,
    rq2,
    rq2_rows,
)
from safevar_sumo.analysis.research_questions.indicators import titles_of
from safevar_sumo.metrics import MetricFacts
from safevar_sumo.records import FloatArray

RQ1_RUNS_COLUMNS = ["setting", "algorithm", "metric", "p_value", "p_holm", "effect_size", "magnitude", "runs", "method", "mean", "original"]
RQ2_RUNS_COLUMNS = ["setting", "baseline", "metric", "p_value", "p_holm", "effect_size", "magnitude", "n1", "n2", "method"]
COUNT_COLUMNS = {"RQ1": ["runs"], "RQ2": ["n1", "n2"]}
"""For each question, the columns with the number of runs in each sample of a test."""
EXACT_SIGNED_TEST = "Wilcoxon signed-rank, two-sided, exact"
ASYMPTOTIC_SIGNED_TEST = "Wilcoxon signed-rank, two-sided, normal approximation with correction for continuity"
MAX_EXACT_RUNS = 50
"""Without ties and differences of zero, the signed-rank test is exact for up to this many runs."""


def rq1_runs(case: Case) -> pd.DataFrame:
    """Every algorithm's run means against the original's value, metric by metric: Wilcoxon's signed-rank test.

    Columns: `RQ1_RUNS_COLUMNS`. `effect_size` is the share of runs whose mean is safer than the original's value, plus half the share of
    equal ones (A12 against one value): below 0.5 the runs are less safe. `mean` is the mean of the run means. `p_holm` is `p_value`
    corrected by Holm's method for all tests of RQ1 and RQ2 of this case. Undefined values are None.

    Raises
    ------
    UnanswerableError
        If the solutions belong to no run, or no run is finished.
    """
    return _corrected_frames(case)[0]


def rq2_runs(case: Case) -> pd.DataFrame:
    """Compare NSGA-II with every other algorithm by Mann-Whitney U, with one value per run: indicators, and metrics' means over solutions.

    Columns: `RQ2_RUNS_COLUMNS`. `effect_size` is A12, oriented as in `rq2`; `n1` and `n2` count runs; `p_holm` is defined as in `rq1_runs`.

    Raises
    ------
    UnanswerableError
        If the solutions belong to no run, NSGA-II is missing, or there is no other algorithm.
    """
    frame = _corrected_frames(case)[1]
    require_rq2_algorithms(case)
    assert frame is not None
    return frame


def correct_by_holm(p_values: Sequence[float | None]) -> list[float | None]:
    """P-values corrected by Holm's step-down method (Holm 1979); None stays None and does not count as a test."""
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected_p_values, maximum = list(p_values), 0.0
    for rank, (p, index) in enumerate(order):
        maximum = max(maximum, min(1.0, p * (len(order) - rank)))
        corrected_p_values[index] = maximum
    return corrected_p_values


def signed_rank_test(sample: FloatArray, value: float) -> TwoSampleTest:
    """Compare independent values, shape (N,), with one value: Wilcoxon's test, and the share of greater values (A12).

    The test drops values equal to `value` (as Wilcoxon did); the effect size counts them by half.
    """
    if not sample.size or np.isnan(value):
        return TwoSampleTest(p_value=None, effect_size=None, magnitude=None, n1=len(sample), n2=0, method=None)
    differences = sample - value
    absolute_differences = np.abs(differences[differences != 0])
    effect = float(np.mean(differences > 0) + np.mean(differences == 0) / 2)
    if not absolute_differences.size:
        return TwoSampleTest(p_value=1.0, effect_size=effect, magnitude=magnitude_of(effect), n1=len(sample), n2=1,
                             method=EXACT_SIGNED_TEST)
    has_ties_or_zeros = np.unique(absolute_differences).size < len(sample)
    is_exact = not has_ties_or_zeros and len(sample) <= MAX_EXACT_RUNS
    test = scipy.stats.wilcoxon(differences, alternative="two-sided", correction=not is_exact, method="exact" if is_exact else "approx")
    method = EXACT_SIGNED_TEST if is_exact else ASYMPTOTIC_SIGNED_TEST
    return TwoSampleTest(p_value=float(test.pvalue), effect_size=effect, magnitude=magnitude_of(effect), n1=len(sample), n2=1,
                         method=method)


def fewest_runs(question: str) -> int:
    """Smallest number of runs with which a test of this question can be significant before any correction.

    The smallest two-sided p-value of n runs is 2 / 2^n by the signed-rank test of RQ1, and 2 / C(2n, n) by the U test of RQ2.
    """
    return next(n for n in range(1, 100) if 2 / (2**n if question == "RQ1" else math.comb(2 * n, n)) < ALPHA)


def algorithms_with_few_runs(case: Case, question: str) -> list[str]:
    """RQ1's algorithms or RQ2's baselines with too few runs for a significant test; none if the runs are unknown (imported)."""
    if not case.has_runs or (question == "RQ2" and NSGA2 not in case.algorithms):
        return []
    runs = {name: len(case.runs_of(name)) for name in case.algorithms}
    most = runs.pop(NSGA2) if question == "RQ2" else math.inf
    return [name for name, number in runs.items() if min(number, most) < fewest_runs(question)]


def significance_change_line(case: Case) -> str:
    """One line: the tests with enough runs that are significant (p < ALPHA) only for the paper's pooled solutions, or only over runs.

    Example: "..., 3 of 28 tests are no longer significant: RQ1 NSGA-II SD, TET; RQ2 SafeFuzzer TET."

    Raises
    ------
    UnanswerableError
        If `rq1_runs` raises it.
    """
    titles = titles_of(case.scoring.metrics)
    rq1_runs_frame, rq2_runs_frame = _corrected_frames(case)
    comparisons = [("RQ1", "algorithm", rq1(case), rq1_runs_frame), *(
        [] if rq2_runs_frame is None else [("RQ2", "baseline", rq2(case), rq2_runs_frame)])]
    changes, test_count = {"no longer": dict[str, list[str]](), "now": dict[str, list[str]]()}, 0
    for question, group_column, pooled_frame, runs_frame in comparisons:
        for pooled_row, runs_row in zip(pooled_frame.to_dict("records"), runs_frame.to_dict("records"), strict=True):
            if min(runs_row[column] for column in COUNT_COLUMNS[question]) < fewest_runs(question):
                continue
            pooled_p, runs_p = pooled_row["p_value"], runs_row["p_holm"]
            test_count += runs_p is not None
            if pooled_p is None or runs_p is None or (pooled_p < ALPHA) == (runs_p < ALPHA):
                continue
            name = ALGORITHM_TITLES.get(pooled_row[group_column], pooled_row[group_column])
            group = changes["no longer" if pooled_p < ALPHA else "now"].setdefault(f"{question} {name}", [])
            group.append(titles[pooled_row["metric"]])
    texts = []
    for word, groups in changes.items():
        count = sum(map(len, groups.values()))
        named = "; ".join(f"{name} {', '.join(metrics)}" for name, metrics in groups.items())
        texts += [f"{count} of {test_count} tests {'is' if count == 1 else 'are'} {word} significant: {named}"] if count else []
    return ("With one value for each run and Holm's correction for the number of tests, instead of the paper's pooled solutions, "
            f"{'. '.join(texts) or 'the same tests are significant'}.")


def notes_over_runs(case: Case, question: str, *, pooling: bool) -> list[str]:
    """Notes on RQ1 or RQ2 over runs: how many tests have too few runs.

    With `pooling`, also the `significance_change_line`, if at least one test of RQ1 or RQ2 has enough runs.
    """
    enough_by_question = {name: _has_enough_runs(frame, name) for name, frame in zip(COUNT_COLUMNS, _corrected_frames(case), strict=True)
                          if frame is not None}
    enough = enough_by_question[question]
    share = "all" if not any(enough) else f"{len(enough) - sum(enough)} of the"
    notes = [] if all(enough) else [f"too few runs for {share} {len(enough)} tests of {question} ({fewest_runs(question)} are needed)."]
    return [*notes, *([significance_change_line(case)] if pooling and any(map(any, enough_by_question.values())) else [])]


def _has_enough_runs(frame: pd.DataFrame, question: str) -> list[bool]:
    """Whether each defined test of a question has enough runs to be significant."""
    defined_rows = frame[frame["effect_size"].notna()]
    return list(defined_rows[COUNT_COLUMNS[question]].min(axis=1) >= fewest_runs(question))


def summary_lines(case: Case) -> list[str]:
    """Lines on RQ1 and RQ2 for the end of a study: effect sizes over runs, significant ones with an asterisk.

    A line says so if there are too few runs for a significant difference. The last line is `significance_change_line`.
    """
    titles = titles_of(case.scoring.metrics)
    lines, any_testable = [], False
    questions = (("RQ1", rq1_runs, "algorithm", "A12 below 0.5: the runs are more unsafe than the original vehicle",
                  "A12 of {} against the original vehicle"),
                 ("RQ2", rq2_runs, "baseline", "A12 above 0.5: NSGA-II is better", "A12 of NSGA-II against {}"))
    for question, frame_of, group_column, meaning, heading in questions:
        try:
            frame = frame_of(case)
        except UnanswerableError as error:
            lines.append(f"{question} over runs: {error.problem}.")
            continue
        lines.append(f"{question} over runs: {meaning}; * p < {ALPHA:g} after Holm's correction")
        for name, group in frame.groupby(group_column, sort=False):
            rows = group.to_dict("records")
            defined_rows = [row for row in rows if row["effect_size"] is not None]
            untestable = [titles[row["metric"]] for row, enough in zip(defined_rows, _has_enough_runs(group, question), strict=True)
                          if not enough]
            any_testable = any_testable or len(untestable) < len(defined_rows)
            named_metrics = "" if len(untestable) == len(defined_rows) else f"{', '.join(untestable)}: "
            note = f"; {named_metrics}too few runs for a test ({fewest_runs(question)} are needed)" if untestable else ""
            effects = ", ".join(f"{titles[row['metric']]} " + ("-" if row["effect_size"] is None or row["p_holm"] is None else
                                f"{row['effect_size']:.2f}{'*' if row['p_holm'] < ALPHA else ''}") for row in rows)
            lines.append(f"  {heading.format(ALGORITHM_TITLES.get(str(name), name))}: {effects}{note}")
    return [*lines, significance_change_line(case)] if any_testable else lines


def _corrected_frames(case: Case) -> tuple[pd.DataFrame, pd.DataFrame | None]:
    """The frames of RQ1 and RQ2 over runs, with p-values corrected as one family; None if RQ2 has no answer."""
    case.require_solutions()
    means = partial(run_means, case)
    rows_of_rq1 = [{**row, "runs": row["n1"]} for row in rq1_rows(case, means, signed_rank_test)]
    has_rq2 = NSGA2 in case.algorithms and len(case.algorithms) > 1
    rows_of_rq2 = rq2_rows(case, means) if has_rq2 else []
    for row, p in zip([*rows_of_rq1, *rows_of_rq2], correct_by_holm([row["p_value"] for row in [*rows_of_rq1, *rows_of_rq2]]), strict=True):
        row["p_holm"] = p
    return (pd.DataFrame(rows_of_rq1, columns=RQ1_RUNS_COLUMNS, dtype=object),
            pd.DataFrame(rows_of_rq2, columns=RQ2_RUNS_COLUMNS, dtype=object) if has_rq2 else None)


def run_means(case: Case, algorithm: str, metric: MetricFacts) -> FloatArray:
    """A metric's mean over the solutions with a defined value, for each finished run that has such solutions; shape (runs,).

    Raises
    ------
    UnanswerableError
        If the solutions belong to no run.
    """
    return np.asarray(run_mean_series(case, algorithm, metric), dtype=float)


def run_mean_series(case: Case, algorithm: str, metric: MetricFacts) -> pd.Series[float]:
    """The means of `run_means`, indexed by the run's number."""
    run_numbers = case.runs_of(algorithm)
    solutions = solutions_for_metric(case.solutions_of(algorithm), metric)  # for TET and TIT without collisions
    runs, column = solutions["run"].to_numpy(), solutions[metric.name].to_numpy(dtype=float)
    defined = ~np.isnan(column)
    samples = {run: column[defined & (runs == run)] for run in run_numbers}
    return pd.Series({run: float(np.mean(sample)) for run, sample in samples.items() if sample.size}, dtype=float)
