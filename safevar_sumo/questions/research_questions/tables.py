"""The tables of the research questions by name: what computes them, what their columns mean, how readers see them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import pandas as pd

from safevar_sumo.questions.answer import Column, Wide, with_interval
from safevar_sumo.questions.research_questions import changes, comparisons
from safevar_sumo.questions.research_questions.fronts import count_evaluations

WEATHER, CAUSES = "weather", "causes"
CHOSEN = ("rq1-runs", "rq2-runs", "medians", "first-collision", CAUSES, "rq1", "rq2")
"""The tables that depend on a reader's choices."""
Hidden = partial(Column, is_shown=False)
"""A column that JSON and CSV alone have."""
Percent, Number = partial(Column, "%", number_format=".1f"), partial(Column, "", number_format=".2f")

CASE = {"setting": Column("", "case: the results of one study")}
ALGORITHM = {"algorithm": Column("", "algorithm")}
BASELINE = {"baseline": Column("", "the other algorithm")}
METRIC = {"metric": Column("", "safety metric or quality of a run's front")}
CHARACTERISTIC = {"characteristic": Column("", "characteristic")}
CHANGES = {"j": Column("", "number of characteristics changed; any: of all critical solutions")}
P_VALUE = {"p_value": Column("", "p-value of the test, two-sided", ".2g")}
UNCORRECTED = {"p_value": Hidden("", "p-value of the test, two-sided, before the correction")}
P_HOLM = {"p_holm": Column("", "p-value after Holm's correction for all tests of RQ1 and RQ2 of a case", ".2g")}
MAGNITUDE = {"magnitude": Column("", "magnitude of the effect by Kitchenham's intervals")}
EFFECT_ON_ORIGINAL = Column("", "A12; below 0.5 the algorithm's are more unsafe than the original vehicle", ".3f")
EFFECT_ON_BASELINE = Column("", "A12; above 0.5 the algorithm is better", ".3f")
RUNS = {"runs": Column("", "number of runs")}
SIZES = {
    "n1": Column("", "number of values of the algorithm"),
    "n2": Column("", "number of values of the other algorithm, or times that the original's value is repeated"),
}
METHOD = {"method": Hidden("", "name of the test")}
ORIGINAL = {
    "mean": Number(meaning="mean of the algorithm's values"),
    "original": Number(meaning="value of the original vehicle"),
}
ENOUGH = {
    "enough_runs": Hidden("", "whether a test with so many runs can be significant"),
    "significant": Column("", "whether p is below alpha, corrected if there is p_holm, and there are enough runs"),
}
OTHER_CASE = {"other": Column("", "case in the other weather")}
SIZE_OF_CHANGE = partial(Column, "as characteristic", number_format="+.3g")


class PaperTable(NamedTuple):
    """A table: its title, the function of a case (of the weather: of all cases) that computes it, and its columns."""

    title: str
    compute: Callable[..., pd.DataFrame]
    columns: Mapping[str, Column]
    wide: Wide | None = None


TABLES: Mapping[str, PaperTable] = {
    "rq1-runs": PaperTable(
        "RQ1 over runs: the means of runs against the original vehicle (effect below 0.5: less safe)",
        comparisons.rq1_runs,
        CASE
        | ALGORITHM
        | METRIC
        | UNCORRECTED
        | P_HOLM
        | with_interval("effect_size", EFFECT_ON_ORIGINAL)
        | MAGNITUDE
        | RUNS
        | METHOD
        | {"mean": Hidden("", "mean of the runs' means")}
        | {"original": ORIGINAL["original"]}
        | ENOUGH,
    ),
    "rq2-runs": PaperTable(
        "RQ2 over runs: an algorithm's runs against those of the others (effect above 0.5: better)",
        comparisons.rq2_runs,
        CASE
        | ALGORITHM
        | BASELINE
        | METRIC
        | UNCORRECTED
        | P_HOLM
        | with_interval("effect_size", EFFECT_ON_BASELINE)
        | MAGNITUDE
        | SIZES
        | METHOD
        | ENOUGH,
    ),
    "medians": PaperTable(
        "Medians over runs",
        comparisons.median_runs,
        CASE | ALGORITHM | METRIC | RUNS | with_interval("median", Column("", "median over the runs")),
    ),
    "first-collision": PaperTable(
        "Evaluations to the first collision of a run",
        comparisons.first_collisions,
        CASE
        | ALGORITHM
        | RUNS
        | {"collided": Column("", "runs with a collision")}
        | with_interval("median", Column("", "median by Kaplan and Meier: runs without a collision need more"))
        | {"p_value": Column("", "p-value of the log-rank test against the algorithm that RQ2 compares", ".2g")}
        | {"p_holm": Column("", "p-value after Holm's correction for these tests", ".2g")},
    ),
    CAUSES: PaperTable(
        "Distinct minimal causes that a run found",
        comparisons.minimal_causes,
        CASE
        | ALGORITHM
        | {
            "run": Column("", "number of the run"),
            "failures": Column("", "different unsafe solutions"),
            "examined": Column("", "those whose minimal causes were simulated"),
            "causes": Column("", "different smallest sets of changes, by characteristic and direction"),
        },
        Wide(["setting", "run"], "algorithm", ["causes"]),
    ),
    "rq1": PaperTable(
        "RQ1 as published, which pools the solutions of all runs: against the original vehicle",
        comparisons.rq1,
        CASE
        | ALGORITHM
        | METRIC
        | P_VALUE
        | {"effect_size": EFFECT_ON_ORIGINAL}
        | MAGNITUDE
        | SIZES
        | METHOD
        | ORIGINAL
        | ENOUGH,
    ),
    "rq2": PaperTable(
        "RQ2 as published, which pools the solutions of all runs: an algorithm against the others",
        comparisons.rq2,
        CASE
        | ALGORITHM
        | BASELINE
        | METRIC
        | P_VALUE
        | {"effect_size": EFFECT_ON_BASELINE}
        | MAGNITUDE
        | SIZES
        | METHOD
        | ENOUGH
        | {
            "evaluations": Hidden("", "mean number of settings that a run of the algorithm simulates"),
            "baseline_evaluations": Hidden("", "mean number of settings that a run of the other simulates"),
        },
    ),
    "evaluations": PaperTable(
        "Different settings that a run simulates",
        count_evaluations,
        CASE
        | ALGORITHM
        | {
            "run": Column("", "number of the run"),
            "requested": Column("", "evaluations that the algorithm requests"),
            "simulated": Column("", "different settings, which are simulated once each"),
            "budget": Column("", "evaluations that a run may request"),
        },
        Wide(["setting", "run"], "algorithm", ["simulated"]),
    ),
    "rq3.1": PaperTable(
        "RQ3.1: critical solutions of a run with j characteristics changed",
        changes.rq31,
        CASE | {"run": Column("", "number of the run")} | CHANGES | {"count": Column("", "critical solutions")},
        Wide(["setting", "run"], "j", ["count"]),
    ),
    "rq3.2": PaperTable(
        "RQ3.2: % of the critical solutions with j changes in which a characteristic is changed",
        changes.rq32,
        CASE
        | CHARACTERISTIC
        | CHANGES
        | {
            "percent": Column("%", "critical solutions that change it", ".0f"),
            "rank": Column("", "rank by the percentage among all critical solutions, in rows of any"),
        },
        Wide(["setting", "characteristic"], "j", ["percent"]),
    ),
    "rq3.3": PaperTable(
        "RQ3.3: size of changes in the critical solutions with j changes",
        changes.rq33,
        CASE
        | CHARACTERISTIC
        | {"direction": Column("", "increase or decrease")}
        | CHANGES
        | {
            "pc": Column("", "PC, the mean change as a share of the original value", ".2f"),
            "delta": SIZE_OF_CHANGE(meaning="mean signed change in the characteristic's unit"),
            "n": Column("", "number of changes"),
        },
        Wide(["setting", "characteristic", "direction"], "j", ["pc", "delta"]),
    ),
    "rq3.3-safety": PaperTable(
        "RQ3.3: effect of the critical solutions with j changes on safety",
        changes.rq33_safety,
        CASE
        | {
            "quantity": Column(
                "",
                "without collisions the reduction of the distance and the increases of TET and TIT; the speed of "
                "collisions; over all solutions the decrease of aveDece",
            )
        }
        | CHANGES
        | {
            "value": Column("as quantity", "mean [m, s, m/s, s^2 or m/s^2]", ".2f"),
            "percent": Column("%", "% of the original's value", ".0f"),
            "n": Column("", "number of solutions"),
        },
        Wide(["setting", "quantity"], "j", ["value", "percent"]),
    ),
    "collisions": PaperTable(
        "Collisions among the solutions",
        changes.count_collisions,
        CASE
        | ALGORITHM
        | {
            "solutions": Column("", "number of solutions"),
            "collisions": Column("", "solutions that collide"),
            "share": Column("", "share of the solutions that collide", ".1%"),
        },
    ),
    "combinations": PaperTable(
        "The most frequent combinations of four changes",
        changes.frequent_combinations,
        CASE
        | {
            "rank": Column("", "rank by frequency"),
            "characteristics": Column("", "what is changed"),
            "percent": Percent(meaning="of the critical solutions with exactly four changes"),
        },
    ),
    WEATHER: PaperTable(
        "One weather against another, over the critical solutions",
        changes.compare_weathers,
        CASE
        | OTHER_CASE
        | CHARACTERISTIC
        | {
            "percent": Percent(meaning="critical solutions that change it"),
            "percent_other": Percent(meaning="the same in the other weather"),
            "difference": Column("%", "percent_other minus percent", "+.1f"),
            "rank": Column("", "rank by percent"),
            "rank_other": Column("", "the same in the other weather"),
            "increase": SIZE_OF_CHANGE(meaning="mean increase, in the characteristic's unit"),
            "increase_other": SIZE_OF_CHANGE(meaning="the same in the other weather"),
            "decrease": SIZE_OF_CHANGE(meaning="mean decrease, in the characteristic's unit"),
            "decrease_other": SIZE_OF_CHANGE(meaning="the same in the other weather"),
        },
    ),
}
