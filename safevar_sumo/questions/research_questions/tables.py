"""The tables of the research questions by name: what computes them, what their columns mean, how readers see them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import pandas as pd

from safevar_sumo.questions.answer import Column, Columns, Wide, with_interval
from safevar_sumo.questions.research_questions import changes, comparisons
from safevar_sumo.questions.research_questions.fronts import count_evaluations

WEATHER, CAUSES = "weather", "causes"
CHOSEN = ("rq1-runs", "rq2-runs", "medians", "first-collision", CAUSES, "rq1", "rq2")
"""The tables that depend on a reader's choices."""
Hidden = partial(Column, is_shown=False)
"""A column that JSON and CSV alone have."""
SIZE_OF_CHANGE = partial(Column, "as characteristic", number_format="+.3g")
SETTING = Column("", "case: the results of one study")
PERCENT = Column("%", "critical solutions that change it", ".1f")
COMMON: Columns = {
    "setting": SETTING,
    "other": "case in the other weather",
    "algorithm": "algorithm",
    "baseline": "the other algorithm",
    "metric": "safety metric or quality of a run's front",
    "characteristic": "characteristic",
    "run": "number of the run",
    "runs": "number of runs",
    "j": "number of characteristics changed; any: of all critical solutions",
    "p_value": Column("", "p-value of the test, two-sided", ".2g"),
    "p_holm": Column("", "p-value after Holm's correction for all tests of RQ1 and RQ2 of a case", ".2g"),
    "magnitude": "magnitude of the effect by Kitchenham's intervals",
    "n1": "number of values of the algorithm",
    "n2": "number of values of the other algorithm, or times that the original's value is repeated",
    "method": Hidden("", "name of the test"),
    "mean": Column("", "mean of the algorithm's values", ".2f"),
    "original": Column("", "value of the original vehicle", ".2f"),
    "enough_runs": Hidden("", "whether a test with so many runs can be significant"),
    "significant": "whether p is below alpha, corrected if there is p_holm, and there are enough runs",
    "percent": PERCENT,
}
"""Columns of several tables."""
UNCORRECTED = Hidden("", "p-value of the test, two-sided, before the correction")
AGAINST_ORIGINAL = with_interval(
    "effect_size", Column("", "A12; below 0.5 the algorithm's are more unsafe than the original vehicle", ".3f")
)
AGAINST_BASELINE = with_interval("effect_size", Column("", "A12; above 0.5 the algorithm is better", ".3f"))
IN_ONE_WEATHER = {
    "percent": PERCENT,
    "rank": Column("", "rank by percent"),
    "increase": SIZE_OF_CHANGE("mean increase, in the characteristic's unit"),
    "decrease": SIZE_OF_CHANGE("mean decrease, in the characteristic's unit"),
}
IN_THE_OTHER = {
    f"{name}_other": column._replace(meaning="the same in the other weather") for name, column in IN_ONE_WEATHER.items()
}


def _columns(names: str, own: Mapping[str, Column | str] = {}) -> Columns:
    """Columns in the order of `names`: a table's own ones, and else the common ones."""
    known = {**COMMON, **own}
    return {name: known[name] for name in names.split()}


class PaperTable(NamedTuple):
    """A table: its title, the function of a case (of the weather: of all cases) that computes it, and its columns."""

    title: str
    compute: Callable[..., pd.DataFrame]
    columns: Columns
    wide: Wide | None = None


TABLES: Mapping[str, PaperTable] = {
    "rq1-runs": PaperTable(
        "RQ1 over runs: the means of runs against the original vehicle (effect below 0.5: less safe)",
        comparisons.rq1_runs,
        _columns(
            "setting algorithm metric p_value p_holm effect_size effect_size_low effect_size_high magnitude runs "
            "method mean original enough_runs significant",
            AGAINST_ORIGINAL | {"p_value": UNCORRECTED, "mean": Hidden("", "mean of the runs' means")},
        ),
    ),
    "rq2-runs": PaperTable(
        "RQ2 over runs: an algorithm's runs against those of the others (effect above 0.5: better)",
        comparisons.rq2_runs,
        _columns(
            "setting algorithm baseline metric p_value p_holm effect_size effect_size_low effect_size_high magnitude "
            "n1 n2 method enough_runs significant",
            AGAINST_BASELINE | {"p_value": UNCORRECTED},
        ),
    ),
    "medians": PaperTable(
        "Medians over runs",
        comparisons.median_runs,
        _columns("setting algorithm metric runs") | with_interval("median", Column("", "median over the runs")),
    ),
    "first-collision": PaperTable(
        "Evaluations to the first collision of a run",
        comparisons.first_collisions,
        _columns("setting algorithm runs")
        | {"collided": "runs with a collision"}
        | with_interval("median", Column("", "median by Kaplan and Meier: runs without a collision need more"))
        | {"p_value": Column("", "p-value of the log-rank test against the algorithm that RQ2 compares", ".2g")}
        | {"p_holm": Column("", "p-value after Holm's correction for these tests", ".2g")},
    ),
    CAUSES: PaperTable(
        "Distinct minimal causes that a run found",
        comparisons.minimal_causes,
        _columns("setting algorithm run")
        | {
            "failures": "different unsafe solutions",
            "examined": "those whose minimal causes were simulated",
            "causes": "different smallest sets of changes, by characteristic and direction",
        },
        Wide(["setting", "run"], "algorithm", ["causes"]),
    ),
    "rq1": PaperTable(
        "RQ1 as published, which pools the solutions of all runs: against the original vehicle",
        comparisons.rq1,
        _columns(
            "setting algorithm metric p_value effect_size magnitude n1 n2 method mean original enough_runs significant",
            AGAINST_ORIGINAL,
        ),
    ),
    "rq2": PaperTable(
        "RQ2 as published, which pools the solutions of all runs: an algorithm against the others",
        comparisons.rq2,
        _columns(
            "setting algorithm baseline metric p_value effect_size magnitude n1 n2 method enough_runs significant",
            AGAINST_BASELINE,
        )
        | {
            "evaluations": Hidden("", "mean number of settings that a run of the algorithm simulates"),
            "baseline_evaluations": Hidden("", "mean number of settings that a run of the other simulates"),
        },
    ),
    "evaluations": PaperTable(
        "Different settings that a run simulates",
        count_evaluations,
        _columns("setting algorithm run")
        | {
            "requested": "evaluations that the algorithm requests",
            "simulated": "different settings, which are simulated once each",
            "budget": "evaluations that a run may request",
        },
        Wide(["setting", "run"], "algorithm", ["simulated"]),
    ),
    "rq3.1": PaperTable(
        "RQ3.1: critical solutions of a run with j characteristics changed",
        changes.rq31,
        _columns("setting run j") | {"count": "critical solutions"},
        Wide(["setting", "run"], "j", ["count"]),
    ),
    "rq3.2": PaperTable(
        "RQ3.2: % of the critical solutions with j changes in which a characteristic is changed",
        changes.rq32,
        _columns("setting characteristic j")
        | {
            "percent": PERCENT._replace(number_format=".0f"),
            "rank": "rank by the percentage among all critical solutions, in rows of any",
        },
        Wide(["setting", "characteristic"], "j", ["percent"]),
    ),
    "rq3.3": PaperTable(
        "RQ3.3: size of changes in the critical solutions with j changes",
        changes.rq33,
        _columns(
            "setting characteristic direction j pc delta n",
            {
                "direction": "increase or decrease",
                "pc": Column("", "PC, the mean change as a share of the original value", ".2f"),
                "delta": SIZE_OF_CHANGE("mean signed change in the characteristic's unit"),
                "n": "number of changes",
            },
        ),
        Wide(["setting", "characteristic", "direction"], "j", ["pc", "delta"]),
    ),
    "rq3.3-safety": PaperTable(
        "RQ3.3: effect of the critical solutions with j changes on safety",
        changes.rq33_safety,
        _columns(
            "setting quantity j value percent n",
            {
                "quantity": (
                    "without collisions the reduction of the distance and the increases of TET and TIT; the speed of "
                    "collisions; over all solutions the decrease of aveDece"
                ),
                "value": Column("as quantity", "mean [m, s, m/s, s^2 or m/s^2]", ".2f"),
                "percent": Column("%", "% of the original's value", ".0f"),
                "n": "number of solutions",
            },
        ),
        Wide(["setting", "quantity"], "j", ["value", "percent"]),
    ),
    "collisions": PaperTable(
        "Collisions among the solutions",
        changes.count_collisions,
        _columns("setting algorithm")
        | {
            "solutions": "number of solutions",
            "collisions": "solutions that collide",
            "share": Column("", "share of the solutions that collide", ".1%"),
        },
    ),
    "combinations": PaperTable(
        "The most frequent combinations of four changes",
        changes.frequent_combinations,
        _columns("setting")
        | {
            "rank": "rank by frequency",
            "characteristics": "what is changed",
            "percent": Column("%", "of the critical solutions with exactly four changes", ".1f"),
        },
    ),
    WEATHER: PaperTable(
        "One weather against another, over the critical solutions",
        changes.compare_weathers,
        _columns(
            "setting other characteristic percent percent_other difference rank rank_other increase increase_other "
            "decrease decrease_other",
            IN_ONE_WEATHER | IN_THE_OTHER | {"difference": Column("%", "percent_other minus percent", "+.1f")},
        ),
    ),
}
