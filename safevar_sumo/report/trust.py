"""The section on limits and trust: what the findings do not cover, and how well the study agrees with published
data.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from safevar_sumo.analysis.explain.result import Explained
from safevar_sumo.analysis.explain.robustness import MIN_ROBUST_SHARE
from safevar_sumo.analysis.model_spread import compute_model_spreads
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Outcome
from safevar_sumo.reference import Totals, shipped_totals_of
from safevar_sumo.report.causes import FIRST_CHOICES, NO_VALUE
from safevar_sumo.report.input import ReportInput
from safevar_sumo.study import SAFETY_DEGREE, Study

GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, "
    "no wind, no sensor "
    "noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    (
        "Driving system and vehicle are models: the tables below show how far they agree with published data, "
        "where there is any."
    ),
)


def describe_agreement(study: Study) -> tuple[str, list[list[str]]]:
    """How well a study agrees with published data: a sentence, and a row of texts for each file; without such data, no
    rows.
    """
    totals = shipped_totals_of(study)
    if not totals:
        return (
            "This study was not compared with published data: whether another simulator or a real vehicle "
            "behaves in the same way "
            "is unknown.",
            [],
        )
    by_collisions = sorted(totals.items(), key=lambda item: (-item[1].collisions["reference"], -item[1].rows))
    sentences = (_agreement_sentence(file, entry) for file, entry in by_collisions)
    return (
        f"Agreement with published data. {' '.join(sentences)}",
        [_agreement_row(file, entry) for file, entry in totals.items()],
    )


def _agreement_sentence(file: str, totals: Totals) -> str:
    counts = totals.collisions
    collisions = (
        "no published collision is among them"
        if totals.recall is None
        else (
            f"{counts['both']} of the {counts['reference']} published collisions collide here too (recall "
            f"{totals.recall:.2f})"
        )
    )
    if totals.precision is not None:
        collisions += (
            f", and {counts['both']} of the {counts['here']} collisions here are published ones "
            f"(precision {totals.precision:.2f})"
        )
    rho = totals.spearman.get(SAFETY_DEGREE)
    order = (
        "" if rho is None else f" the rank correlation of the safety degrees is {rho:.2f} (1: the same order, 0: none);"
    )
    return f"{file}, {totals.rows} vehicles simulated again:{order} {collisions}."


def _agreement_row(file: str, totals: Totals) -> list[str]:
    """The texts of a row: file, vehicles, rank correlation, mean error, collisions published, here and in both, recall,
    precision.
    """

    def decimal(value: float | None) -> str:
        return NO_VALUE if value is None else f"{value:.2f}"

    degree_agreement = totals.spearman.get(SAFETY_DEGREE), totals.mean_absolute_error.get(SAFETY_DEGREE)
    return [
        file,
        str(totals.rows),
        *map(decimal, degree_agreement),
        *(str(totals.collisions[side]) for side in ("reference", "here", "both")),
        *map(decimal, (totals.recall, totals.precision)),
    ]


def describe_limits(data: ReportInput, explained: Explained | None) -> dict[str, Any]:
    """Describe how far the findings of one study hold, and how well it agrees with published data.

    `published` lists metrics of the original vehicle: name, published value, value here. `spread` lists vehicles: name,
    safety degree here, safety degrees with the study's other parameter sets.
    """
    case = data.case
    published = [
        (name, case.study.published[name], case.original[name])
        for name in METRICS
        if name in case.study.published and not math.isnan(case.original[name])
    ]
    counts = {
        outcome: int((case.evaluations["outcome"] == str(outcome)).sum())
        for outcome in (Outcome.SIMULATOR_ERROR, Outcome.INVALID_TEST)
    }
    of_all, borderline = (
        f"of {len(case.evaluations)} settings",
        [failure for failure in explained.explanations if failure.robustness.borderline] if explained else [],
    )
    remarks = {
        f"{counts[Outcome.SIMULATOR_ERROR]} {of_all} could not be simulated; no result contains them.": counts[
            Outcome.SIMULATOR_ERROR
        ],
        f"{counts[Outcome.INVALID_TEST]} {of_all} left the tolerance of a test's speed before the driving "
        "system acted: they are neither "
        "failures nor successes.": counts[Outcome.INVALID_TEST],
        f"{len(borderline)} of {len(explained.explanations) if explained else 0} failures analysed are "
        "borderline: fewer than "
        f"{100 * MIN_ROBUST_SHARE:.0f} % of their neighbours are unsafe too.": explained and explained.explanations,
        "There are no published values of the original vehicle to compare the study with.": not published,
    }
    spread = []
    if case.study.spread and data.system is not None:
        handles = data.select_handles(*FIRST_CHOICES) if data.any_unsafe else []
        settings = [case.characteristics.original, *map(data.setting_of, handles)]
        degrees = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
        spread = list(
            zip(
                ("original vehicle", *handles),
                degrees,
                compute_model_spreads(case.study, np.stack(settings), data.point),
                strict=True,
            )
        )
    return {
        "general_limits": GENERAL_LIMITS,
        "remarks": [remark for remark, applies in remarks.items() if applies],
        "published": published,
        "spread": spread,
    }
