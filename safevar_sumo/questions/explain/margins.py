"""How an answer depends on the margin that the original keeps, in a study that searches its
scenario.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from msgspec.structs import replace as replace_in

from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.causes import (
    find_cause_limits,
    find_minimal_causes,
    settings_of,
)
from safevar_sumo.questions.explain.failures import Population
from safevar_sumo.questions.explain.robustness import (
    MIN_ROBUST_SHARE,
    find_smallest_robust_failure,
    robust_shares,
)
from safevar_sumo.questions.tables import Column, Columns, tabulate
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.study import ORIGINAL_DEGREE

FACTORS = (0.5, 1.0, 2.0)
"""Factors of the study's margin."""
STAGE = "encounters with other margins"
MARGINS: Columns = {
    "margin": Column("m", "distance that the original vehicle keeps in the same encounter", ".3g"),
    "settings": (
        "explained settings whose originals keep so much; below the study's margin also those"
        " left out"
    ),
    "failures": "those that are unsafe",
    "boundary": Column(
        "", "smallest robust cause among them, scaled back as far as it stays unsafe", ".5g"
    ),
    "robust_share": Column("-", "share of its neighbours that are unsafe, too", ".2f"),
}


def margins_table(population: Population, evaluator: Evaluator, limit: int) -> pd.DataFrame:
    """A row of `MARGINS` for each margin; none unless the study searches its scenario, and where a
    user names solutions.
    """
    study = evaluator.study
    rows = list[JsonObject]()
    if study.scenario.search and not population.is_named:
        # Settings that count with the smallest margin.
        margins = dict.fromkeys(factor * study.scenario.margin for factor in FACTORS)
        least = _with_margin(evaluator, min(margins))
        further = least.evaluate(population.left_out, STAGE)
        runs = (
            population.evaluations
            if not len(further)
            else Evaluations.concatenate([population.evaluations, further])
        )
        contact = evaluator.system.contact

        # Those that count with each margin, and their smallest robust cause.
        for margin in margins:
            counts = runs.valid & (runs.column(ORIGINAL_DEGREE) >= margin + contact)
            fails = counts & population.unsafe.of(runs)
            cause = _smallest_cause(
                _with_margin(evaluator, margin), runs.take(np.flatnonzero(fails)), population, limit
            )
            rows.append(
                {
                    "margin": margin,
                    "settings": int(counts.sum()),
                    "failures": int(fails.sum()),
                    **cause,
                }
            )
    frame = pd.DataFrame(rows, columns=[*MARGINS])
    return tabulate("By the margin of the original", MARGINS, frame)


def _with_margin(evaluator: Evaluator, margin: float) -> Evaluator:
    study = evaluator.study
    return evaluator.for_study(
        replace_in(study, scenario=replace_in(study.scenario, margin=margin)), verified=0
    )


def _smallest_cause(
    evaluator: Evaluator, failures: Evaluations, population: Population, limit: int
) -> JsonObject:
    """The most robust cause of the smallest robust failure, if there is one."""
    # The smallest robust failure, and its causes.
    unsafe = population.unsafe
    step = evaluator.system.step
    most = limit // len(evaluator.system.points)  # an evaluation simulates a setting at every point
    row = (
        find_smallest_robust_failure(evaluator, failures, step, unsafe, most)
        if len(failures)
        else None
    )
    causes = (
        [] if row is None else find_minimal_causes(evaluator, failures.settings[[row]], unsafe)[0]
    )
    if not causes:
        return {}

    # The most robust of them, if it is robust.
    shares = robust_shares(
        evaluator, settings_of(evaluator.characteristics, causes), step, unsafe
    ).mean(axis=1)
    best = int(np.argmax(shares))
    if shares[best] < MIN_ROBUST_SHARE:
        return {}
    (limits,) = find_cause_limits(evaluator, [causes[best]], unsafe)
    return {"boundary": limits.boundary, "robust_share": float(shares[best])}
