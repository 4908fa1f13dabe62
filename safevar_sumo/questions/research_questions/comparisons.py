"""Statistical tests for RQ1 (an algorithm's solutions against the original vehicle) and RQ2 (an
algorithm against the others). Tests use pooled solutions, as in the paper, or runs.

The paper pools the solutions of all runs and compares them with a second sample: the original's
single value, repeated once for each solution. Solutions of one run resemble each other, and a
repeated value is no sample: p-values become too small. Over runs, each run contributes one value.
Holm's method then corrects the p-values for the number of tests, separately for RQ1 and RQ2.

In the frames, `method` holds the name of the test. `enough_runs` says whether a test of so many
runs can be significant. `significant` says whether the test is significant, and is undefined if
nothing was tested. Undefined values are NaN. Functions of a case raise `UnanswerableError` if no
run is finished, if a compared algorithm is missing, or, over runs, if the solutions belong to no
run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Measure
from safevar_sumo.questions.answer import JsonRows
from safevar_sumo.questions.case import (
    NSGA2,
    Results,
    UnanswerableError,
    solutions_for_metric,
)
from safevar_sumo.questions.research_questions.fronts import (
    INDICATOR_TITLES,
    MORE_IS_BETTER,
    compute_indicators,
    count_evaluations,
    nondominated_evaluations,
    valid_evaluations,
)
from safevar_sumo.questions.research_questions.statistics import (
    ALPHA,
    can_be_significant,
    compare_samples,
    correct_by_holm,
    effect_interval,
    median_interval,
    signed_rank_test,
)
from safevar_sumo.study import ORIGINAL_DEGREE, SAFETY_DEGREE

CAUSES, BEST = "causes", "best_safety_degree"
OPTIONAL_DIRECTIONS = {CAUSES: True, BEST: False}
"""For samples that only some tables have: True if a larger value means a better algorithm. CAUSES
is the number of minimal causes of a run, BEST is the lowest safety degree of a run.
"""
MARKS = {"large": "L", "medium": "M", "small": "S", "negligible": ""}
"""Letters for the magnitudes of effects in the table for a paper."""
Samples = Mapping[tuple[str, str], "pd.Series[float]"]
"""Values by algorithm and name of a metric or quality indicator."""


class Choices(NamedTuple):
    """What a reader chooses.

    Attributes
    ----------
    algorithm
        The algorithm that RQ2 compares with all others; "" for the default of `opponents_of`.
    alpha
        The level of significance.
    causes
        By a case's name, the numbers of minimal causes of its runs, in the columns algorithm, run
        and causes; only cases whose causes were counted.
    """

    algorithm: str = ""
    alpha: float = ALPHA
    causes: Mapping[str, pd.DataFrame] = {}


DEFAULT = Choices()


def rq1(case: Results, choices: Choices = DEFAULT) -> pd.DataFrame:
    """Compare, for each metric, every algorithm's pooled solutions with the original's value, which
    is repeated once for each solution.

    `effect_size` is A12, oriented so that smaller values mean that the algorithm's solutions are
    more unsafe. `mean` is the mean over the algorithm's solutions, and `original` is the original
    vehicle's value.
    """
    return _with_significance(pd.DataFrame(_test_original(case, choices)), choices)


def rq2(case: Results, choices: Choices = DEFAULT) -> pd.DataFrame:
    """Compare an algorithm, which `opponents_of` chooses, with every other algorithm (baseline).
    Compared are the quality indicators of runs and the metrics of pooled solutions.

    `effect_size` is A12, oriented so that higher values mean that the algorithm is better: a better
    front, or more unsafe solutions. `n1` and `n2` are the numbers of values of the algorithm and of
    the baseline. `evaluations` and `baseline_evaluations` are mean numbers of settings that a run
    simulated. Indicators and evaluations of imported solutions, which belong to no run, are
    undefined.
    """
    frame = pd.DataFrame(_test_opponents(case, choices))
    simulated = pd.Series(dtype=float)
    if case.has_runs and len(case.evaluations):
        simulated = count_evaluations(case).groupby("algorithm")["simulated"].mean()
    sides = {"evaluations": "algorithm", "baseline_evaluations": "baseline"}
    for name, side in sides.items():
        frame[name] = frame[side].map(simulated).astype(float)
    return _with_significance(frame, choices)


def rq1_runs(case: Results, choices: Choices = DEFAULT) -> pd.DataFrame:
    """Compare, for each metric, the means of every algorithm's runs with the original's value by
    Wilcoxon's signed-rank test.

    `effect_size` is the share of runs whose mean is safer than the original's value, plus half the
    share of equal means (A12 against one value): below 0.5 the runs are less safe. `mean` is the
    mean of the runs' means. `p_holm` is `p_value`, corrected by Holm's method for all tests of RQ1
    of this case. `enough_runs` says whether the corrected p-value can be significant.
    """
    tests = compare_over_runs(case, choices)
    return tests[tests.index == "RQ1"]


def rq2_runs(
    case: Results, choices: Choices = DEFAULT, further: Samples | None = None
) -> pd.DataFrame:
    """Compare an algorithm with every other algorithm by the Mann-Whitney U test, with one value
    for each run. The values are quality indicators, means of metrics over solutions and, if they
    were counted, numbers of distinct minimal causes.

    `effect_size` is A12, oriented as in `rq2`. `n1` and `n2` are numbers of runs. `p_holm` and
    `enough_runs` are as in `rq1_runs`, for all tests of RQ2. `further` are more samples to compare.
    """
    tests = compare_over_runs(case, choices, further)
    # The call raises an error if RQ2 has no answer.
    opponents_of(case, choices.algorithm)
    return tests[tests.index == "RQ2"]


def rq2_common(case: Results, choices: Choices = DEFAULT) -> pd.DataFrame:
    """The tests of `rq2_runs`, but with one rule for the solutions of a run, whatever the
    algorithm: all evaluations that no other evaluation of the run dominates. A further test
    compares the best safety degree of a run.

    Raises
    ------
    UnanswerableError
        If there are no evaluations.
    """
    common = replace(case, solutions=nondominated_evaluations(case))
    valid = valid_evaluations(case, case.evaluations)
    best = valid.groupby(["algorithm", "run"])[SAFETY_DEGREE].min()
    # A run without valid evaluations counts as the worst run.
    best = best.reindex(pd.MultiIndex.from_tuples(case.finished), fill_value=math.inf)
    further = {(name, BEST): best[name] for name in case.algorithms}
    # The causes were counted among the solutions that the algorithms returned.
    return rq2_runs(common, choices._replace(causes={}), further)


def effects(case: Results, choices: Choices = DEFAULT) -> pd.DataFrame:
    """`rq2_runs` in short, for a paper: with a column a12, the effect size with marks."""
    tests = rq2_runs(case, choices)
    texts = []
    facts = tests[["effect_size", "significant", "magnitude"]]
    for effect, is_significant, magnitude in facts.itertuples(index=False):
        text = "-"
        if magnitude in MARKS:
            asterisk = "*" if is_significant else ""
            text = f"{effect:.2f}{asterisk} {MARKS[magnitude]}".strip()
        texts.append(text)
    return tests.assign(a12=texts)


def compare_over_runs(
    case: Results, choices: Choices, further: Samples | None = None
) -> pd.DataFrame:
    """Every test of RQ1 over runs and, if there are two algorithms, every test of RQ2, which also
    compares the `further` samples. The index is the question, RQ1 or RQ2.
    """
    rows = {"RQ1": _test_original(case, choices, over_runs=True)}
    if len(case.algorithms) > 1:
        rows["RQ2"] = _test_opponents(case, choices, over_runs=True, further=further)
    families = {
        question: _corrected_by_holm(question, tests, choices.alpha)
        for question, tests in rows.items()
    }
    tests = _with_significance(pd.concat(families).droplevel(1), choices)
    return with_intervals(tests, choices.alpha)


def _corrected_by_holm(question: str, rows: JsonRows, alpha: float) -> pd.DataFrame:
    """The tests of a question over runs, with p-values that are corrected for all these tests.
    `enough_runs`, which the rows state for a test alone, is that of corrected p-values.
    """
    tests = pd.DataFrame(rows)
    count = int(tests["p_value"].count())
    tests["p_holm"] = correct_by_holm(tests["p_value"])
    tests["enough_runs"] = [
        can_be_significant(question, row["n1"], row["n2"], alpha, count) for row in rows
    ]
    return tests


def _with_significance(tests: pd.DataFrame, choices: Choices) -> pd.DataFrame:
    """Add the column `significant`. A test is significant if its p-value is below the level, and
    the runs are enough for a test. If there is a corrected p-value, the corrected one counts.
    """
    p_values = tests["p_holm" if "p_holm" in tests else "p_value"]
    is_significant = ((p_values < choices.alpha) & tests["enough_runs"]).astype(
        "boolean"
    )
    return tests.assign(significant=is_significant.where(p_values.notna()))


def with_intervals(tests: pd.DataFrame, alpha: float) -> pd.DataFrame:
    """Add the intervals of the effect sizes. A test of RQ2 compares `n1` with `n2` runs, and a test
    of RQ1 compares `n1` runs with one value; the index says which question it is.
    """
    sizes = tests["n2"].where(tests.index != "RQ1")
    intervals = map(
        partial(effect_interval, alpha=alpha), tests["effect_size"], tests["n1"], sizes
    )
    low, high = zip(*intervals, strict=True)
    return tests.assign(effect_size_low=low, effect_size_high=high)


def medians_over_runs(case: Results, choices: Choices = DEFAULT) -> pd.DataFrame:
    """The medians, with intervals, of every indicator and metric over the runs of each algorithm.
    The columns are algorithm, metric, runs, median, median_low and median_high.
    """
    case.require_solutions()
    samples = _samples(case, choices, over_runs=True)
    rows = []
    for (algorithm, metric), values in samples.items():
        interval = median_interval(values, choices.alpha)
        rows.append((algorithm, metric, len(values), values.median(), *interval))
    return pd.DataFrame(
        rows,
        columns=["algorithm", "metric", "runs", "median", "median_low", "median_high"],
    )


def minimal_causes(case: Results, choices: Choices) -> pd.DataFrame:
    """The numbers of distinct minimal causes that the runs found, as `Choices.causes` holds them.

    Raises
    ------
    UnanswerableError
        If the causes were not counted, or the solutions belong to no run.
    """
    case.require_runs()
    if case.name not in choices.causes:
        raise UnanswerableError(
            case.name,
            "minimal causes are simulated only if they are asked for",
            "causes",
        )
    return choices.causes[case.name]


def opponents_of(case: Results, algorithm: str) -> tuple[str, list[str]]:
    """The algorithm that RQ2 compares, and all other algorithms. The default is NSGA-II, else the
    study's first algorithm with results.

    Raises
    ------
    UnanswerableError
        If the algorithm has no finished run, or there is no other algorithm.
    """
    case.require_solutions()
    if not algorithm:
        algorithm = NSGA2 if NSGA2 in case.algorithms else case.algorithms[0]
    # The call raises an error if the algorithm has no finished run.
    case.solutions_of(algorithm)
    opponents = [name for name in case.algorithms if name != algorithm]
    if not opponents:
        example = "rs"
        if algorithm == "rs":
            example = NSGA2
        raise UnanswerableError(
            case.name,
            f"only {algorithm} has finished runs",
            f"results of another algorithm, such as {example}",
        )
    return algorithm, opponents


def _test_original(
    case: Results, choices: Choices, *, over_runs: bool = False
) -> JsonRows:
    """The tests of RQ1: a row for each algorithm and metric, against the original vehicle."""
    case.require_solutions()
    rows = []
    for algorithm, metric in product(case.algorithms, case.scoring.metrics):
        values = _values(case, algorithm, metric, over_runs)
        originals = _originals(case, algorithm, metric, over_runs)
        original = (
            originals.mean()
            if case.study.ranges
            else case.original_metrics[metric.name]
        )
        if over_runs:
            test = signed_rank_test(values, originals.reindex(values.index))
            runs = test.n1
        else:
            test = compare_samples(values, originals.dropna())
            runs = case.run_counts[algorithm]
        # Below 0.5, the solutions are more unsafe than the original.
        test = test.oriented(larger_is_better=not metric.more_is_unsafe)
        is_enough = not case.has_runs or can_be_significant(
            "RQ1", runs, 0, choices.alpha
        )
        rows.append(
            {
                "algorithm": algorithm,
                "metric": metric.name,
                "runs": runs,
                "mean": values.mean(),
                "original": original,
                "enough_runs": is_enough,
                **test._asdict(),
            }
        )
    return rows


def _test_opponents(
    case: Results,
    choices: Choices,
    *,
    over_runs: bool = False,
    further: Samples | None = None,
) -> JsonRows:
    """The tests of RQ2: a row for each baseline (other algorithm) and each indicator or metric,
    also of the `further` samples.
    """
    algorithm, opponents = opponents_of(case, choices.algorithm)
    samples = {**_samples(case, choices, over_runs), **(further or {})}
    # By name, whether a larger value means a better algorithm: a better front, more unsafe
    # solutions, or more causes.
    directions = {metric.name: metric.more_is_unsafe for metric in case.scoring.metrics}
    directions = MORE_IS_BETTER | directions | OPTIONAL_DIRECTIONS
    rows = []
    for baseline, (metric, more_is_better) in product(opponents, directions.items()):
        values = samples.get((algorithm, metric), ())
        if metric in OPTIONAL_DIRECTIONS and (algorithm, metric) not in samples:
            continue
        test = compare_samples(values, samples.get((baseline, metric), ()))
        test = test.oriented(larger_is_better=more_is_better)
        runs = case.run_counts[algorithm], case.run_counts[baseline]
        is_enough = not case.has_runs or can_be_significant("RQ2", *runs, choices.alpha)
        rows.append(
            {
                "algorithm": algorithm,
                "baseline": baseline,
                "metric": metric,
                "enough_runs": is_enough,
                **test._asdict(),
            }
        )
    return rows


def _samples(case: Results, choices: Choices, over_runs: bool) -> Samples:
    """The values of every metric and, unless the solutions belong to no run, of every quality
    indicator. Over runs, the numbers of minimal causes are added, if they were counted.
    """
    samples = {}
    for name, metric in product(case.algorithms, case.scoring.metrics):
        samples[name, metric.name] = _values(case, name, metric, over_runs)
    if case.has_runs and len(case.solutions):
        for algorithm, rows in compute_indicators(case).groupby(level="algorithm"):
            for indicator, values in rows.droplevel("algorithm").items():
                samples[str(algorithm), str(indicator)] = values
    if over_runs and case.name in choices.causes:
        counts = choices.causes[case.name].set_index("run")
        for label, values in counts.groupby("algorithm")[CAUSES]:
            samples[str(label), CAUSES] = values
    return samples


def _values(
    case: Results, algorithm: str, metric: Measure, over_runs: bool, column: str = ""
) -> pd.Series[float]:
    """The defined values of a column, by default the metric's, over the solutions that count for
    the metric, or, with `over_runs`, their mean in each run.
    """
    column = column or metric.name
    solutions = solutions_for_metric(case.solutions_of(algorithm), metric)
    solutions = solutions.dropna(subset=column)
    values = solutions[column].astype(float)
    if not over_runs:
        return values
    case.require_runs()
    return values.groupby(solutions["run"]).agg(
        lambda sample: np.mean(sample.to_numpy())
    )


def _originals(
    case: Results, algorithm: str, metric: Measure, over_runs: bool
) -> pd.Series[float]:
    """The original vehicle's metric beside each of `_values`. If encounters are ranges, only the
    safety degree of the original vehicle is known in the same encounters: then other metrics are
    NaN.
    """
    values = _values(case, algorithm, metric, over_runs)
    if not case.study.ranges:
        return pd.Series(
            case.original_metrics[metric.name], index=values.index, dtype=float
        )
    if metric.name != SAFETY_DEGREE:
        return pd.Series(np.nan, index=values.index, dtype=float)
    # Every solution has both degrees: in its encounter, the original vehicle is safe.
    return _values(case, algorithm, metric, over_runs, ORIGINAL_DEGREE)


def describe_runs_without_solutions(case: Results) -> str:
    """Sentences that say which algorithms have runs without solutions, and how these runs count; ""
    if all finished runs have solutions.
    """
    if not case.has_runs:
        return ""

    runs_with_solutions = case.solutions.groupby("algorithm")["run"].nunique()
    texts = []
    for name in case.algorithms:
        count = runs_with_solutions.get(name, 0)
        runs = case.run_counts[name]
        if count < runs:
            texts.append(f"{case.title_of(name)} {count} of {runs}")
    if not texts:
        return ""
    return (
        f"Only these runs of {case.name} have a solution: {', '.join(texts)}. Runs without a"
        " solution count as the worst runs (hypervolume 0, and the worst IGD+, IGD and safety"
        " degree). Means over solutions leave out such runs, and a median may be undefined."
    )


def titles_of(cases: Iterable[Results]) -> dict[str, str]:
    """Titles of algorithms, quality indicators and the cases' metrics, by name."""
    algorithms = dict[str, str]()
    metrics = dict[str, str]()
    for case in cases:
        algorithms |= {name: case.title_of(name) for name in case.algorithms}
        metrics |= {metric.name: metric.title for metric in case.scoring.metrics}
    return algorithms | INDICATOR_TITLES | metrics | {BEST: "best SD of a run"}
