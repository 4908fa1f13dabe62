"""What the comparisons over runs say, in sentences: notes of tables, and the lines of a study's summary."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.comparisons import compare_over_runs, nsga2_pairs, rq1, rq2, titles_of
from safevar_sumo.analysis.research_questions.statistics import ALPHA, fewest_runs
from safevar_sumo.analysis.words import two_decimals


def _tests_over_runs(case: Case) -> pd.DataFrame:
    """Every test of RQ1 and RQ2 over runs, with algorithm and metric in words; columns question, algorithm, metric,
    effect_size, p_holm, ...

    `pooled_p` is the p-value over the paper's pooled solutions; `enough` is whether there are enough runs for the test
    to be significant.
    """
    frames = []
    titles = titles_of(case.scoring.metrics)
    for question, frame in compare_over_runs(case).items():
        if question == "RQ1":
            pooled_frame = rq1(case)
            group = "algorithm"
            counts = ["runs"]
        else:
            pooled_frame = rq2(case)
            group = "baseline"
            counts = ["n1", "n2"]
        frames.append(
            frame.assign(
                question=question,
                algorithm=frame[group].map(lambda name: ALGORITHM_TITLES.get(name, name)),
                metric=frame["metric"].map(titles),
                pooled_p=pooled_frame["p_value"],
                enough=frame[counts].min(axis=1) >= fewest_runs(question),
            )
        )
    return pd.concat(frames, ignore_index=True)


def notes_over_runs(case: Case, question: str, *, pooling: bool) -> list[str]:
    """Notes on RQ1 or RQ2 over runs: how many tests have too few runs.

    With `pooling`, also the `significance_change_line`, if at least one test of RQ1 or RQ2 has enough runs.
    """
    tests = _tests_over_runs(case).dropna(subset="effect_size")
    enough = tests.loc[tests["question"] == question, "enough"]
    how_many = f"{(~enough).sum()} of the" if enough.any() else "all"
    too_few = f"too few runs for {how_many} {len(enough)} tests of {question} ({fewest_runs(question)} are needed)."
    return [
        *([] if enough.all() else [too_few]),
        *([significance_change_line(case)] if pooling and tests["enough"].any() else []),
    ]


def significance_change_line(case: Case) -> str:
    """One line: the tests with enough runs that are significant (p < ALPHA) only for the paper's pooled solutions, or
    only over runs.

    Example: "..., 3 of 28 tests are no longer significant: RQ1 NSGA-II SD, TET; RQ2 SafeFuzzer TET."
    """
    tests = _tests_over_runs(case)
    tests = tests[tests["enough"]].dropna(subset="p_holm")
    texts = []
    was_significant, is_significant = (tests[column].astype(float) < ALPHA for column in ("pooled_p", "p_holm"))
    for word, changes in (
        ("no longer", tests[was_significant & ~is_significant]),
        ("now", tests[~was_significant & is_significant]),
    ):
        groups = changes.dropna(subset="pooled_p").groupby(["question", "algorithm"], sort=False)["metric"]
        named = "; ".join(f"{question} {name} {', '.join(metrics)}" for (question, name), metrics in groups)
        count = groups.size().sum()
        if count:
            texts.append(f"{count} of {len(tests)} tests {'is' if count == 1 else 'are'} {word} significant: {named}")
    return (
        "With one value for each run and Holm's correction for the number of tests, instead of the paper's pooled "
        f"solutions, {'. '.join(texts) or 'the same tests are significant'}."
    )


def summary_lines(case: Case) -> list[str]:
    """Lines on RQ1 and RQ2 for the end of a study: effect sizes over runs, significant ones with an asterisk."""
    try:
        tests = _tests_over_runs(case)
    except UnanswerableError as error:
        return [f"RQ1 and RQ2 over runs: {error.problem}."]
    lines = list[str]()
    for question, meaning, heading in (
        ("RQ1", "below 0.5: the runs are more unsafe than the original vehicle", "{} against the original vehicle"),
        ("RQ2", "above 0.5: NSGA-II is better", "NSGA-II against {}"),
    ):
        lines.append(f"{question} over runs: A12 {meaning}; * p < {ALPHA:g} after Holm's correction")
        for name, group in tests[tests["question"] == question].groupby("algorithm", sort=False):
            marks = np.where(group["p_holm"].astype(float) < ALPHA, "*", "")
            effects = group["metric"] + " " + group["effect_size"].map(two_decimals) + marks
            untestable = ", ".join(group.loc[~group["enough"] & group["effect_size"].notna(), "metric"])
            too_few = (
                f"; too few runs for a test ({fewest_runs(question)} are needed): {untestable}" if untestable else ""
            )
            lines.append(f"  A12 of {heading.format(name)}: {', '.join(effects)}{too_few}")
    try:
        nsga2_pairs(case)
    except UnanswerableError as error:
        lines[-1] = f"RQ2 over runs: {error.problem}."  # replaces RQ2's heading
    return [*lines, significance_change_line(case)] if tests["enough"].any() else lines
