"""Compares algorithms after equal numbers of simulations (budgets), from the journals of their
runs. Compared are the hypervolume and the number of unsafe settings of all settings so far. A plan
says how many runs would show a difference.

A simulation is a setting of a journal, because a run simulates equal settings once. A run that
simulates fewer settings than a budget counts with all its settings.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.questions.case import Results
from safevar_sumo.questions.research_questions.comparisons import (
    Choices,
    rq2_runs,
    with_intervals,
)
from safevar_sumo.questions.research_questions.fronts import (
    frames_of_runs,
    hypervolume,
    minimised_values,
    normalised,
    reference_front,
    valid_evaluations,
)

BUDGETS = (
    100,
    200,
    500,
    1_000,
    2_000,
    5_000,
    10_000,
    20_000,
    50_000,
    100_000,
    200_000,
    500_000,
)
"""Numbers of simulations of a run after which algorithms are compared. They are also compared after
the whole budget of a run.
"""
POWER = 0.8
"""Probability with which a planned number of runs shows an effect."""


def within_budgets(case: Results) -> pd.DataFrame:
    """All settings that the finished runs of a case might return. A setting has a row for each
    budget in which it was simulated. The column `simulations` is the budget: one of `BUDGETS`, or
    the whole budget of a run.

    Raises
    ------
    UnanswerableError
        If there are no evaluations.
    """
    rows = pd.concat([rows for _, rows in frames_of_runs(case, case.evaluations)])
    rows = rows.assign(evaluation=rows.groupby(["algorithm", "run"]).cumcount())
    rows = valid_evaluations(case, rows)
    largest = case.study.search.evaluations
    budgets = np.union1d(np.minimum(BUDGETS, largest), largest)
    parts: list[pd.DataFrame] = [
        rows[rows["evaluation"] < budget].assign(simulations=budget)
        for budget in budgets
    ]
    return pd.concat(parts)


def compare_budgets(case: Results, choices: Choices) -> pd.DataFrame:
    """Compare every pair of algorithms within each budget.

    `effect_size` is A12 of the hypervolume of the runs, above 0.5 if the algorithm is better.
    `hypervolume` is the median over all finished runs. `unsafe` is the mean number of unsafe
    settings over all finished runs. A run without a valid setting within the budget has 0 of both.
    The reference front is the same for all budgets.

    `runs_needed` is the number N / 2 of runs of each algorithm with which a Mann-Whitney test shows
    the effect: N = (z_{1 - level / 2} + z_{power})^2 / (12 c (1 - c) (A12 - 0.5)^2) with c = 1 / 2.
    The formula is for many runs without ties (Noether 1987: Sample size determination for some
    common nonparametric tests. Journal of the American Statistical Association 82, 645-647). The
    number is infinite if A12 is 0.5. The level is alpha divided by the number of tests of
    `rq2_runs`, because Holm's method multiplies the smallest p-value by this number.

    Raises
    ------
    UnanswerableError
        If there are no evaluations or no solutions, or a single algorithm.
    """
    # The call raises an error if there is a single algorithm.
    tests = rq2_runs(case, choices)
    count = tests["p_value"].count()
    reference = reference_front(case)
    unsafe = case.unsafe
    runs = []
    for budget, valid in within_budgets(case).groupby("simulations"):
        for run, rows in frames_of_runs(case, valid):
            points = normalised(minimised_values(case, rows), reference)
            volume = hypervolume(points, case.study.search.reference_point)
            runs.append((*run, budget, volume, unsafe.rows(rows).sum()))
    growth = pd.DataFrame(
        runs, columns=["algorithm", "n1", "simulations", "hypervolume", "unsafe"]
    )

    # A12 is the share of all pairs of runs in which the first run is better, plus half of the share
    # of ties.
    baselines = growth.rename(columns={"algorithm": "baseline", "n1": "n2"})
    pairs = growth.merge(baselines, on="simulations", suffixes=("", "_baseline"))
    pairs["effect_size"] = np.heaviside(
        (pairs["hypervolume"] - pairs["hypervolume_baseline"]).round(12), 0.5
    )
    groups = pairs.query("algorithm < baseline").groupby(
        ["algorithm", "baseline", "simulations"], as_index=False
    )
    frame = groups.agg(
        {
            "effect_size": "mean",
            "n1": "nunique",
            "n2": "nunique",
            "hypervolume": "median",
            "hypervolume_baseline": "median",
            "unsafe": "mean",
            "unsafe_baseline": "mean",
        }
    )
    quantiles = scipy.stats.norm.isf(
        [choices.alpha / 2 / max(count, 1), 1 - POWER]
    ).sum()
    frame["runs_needed"] = np.ceil((quantiles / (frame["effect_size"] - 0.5)) ** 2 / 6)
    return with_intervals(frame, choices.alpha)
