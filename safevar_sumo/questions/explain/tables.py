"""The tables of `explain`: failures, their causes, the characteristics that failures need, and the
drivers that would have avoided them.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.cause_limits import Limits, find_cause_limits
from safevar_sumo.questions.causes import (
    BOUNDARIES,
    OTHER_SETS,
    Causes,
    are_causes,
    directions,
    settings_of,
)
from safevar_sumo.questions.counterexamples import values_as_printed
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.failures import (
    Population,
    Reasons,
    compare_at_points,
)
from safevar_sumo.questions.explain.robustness import MIN_ROBUST_SHARE, robust_shares
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.preventability import (
    COLUMNS as DRIVER_COLUMNS,
    assess_collisions,
    avoided_by,
    drivers_frame,
    has_reference_drivers,
)
from safevar_sumo.questions.tables import (
    AnswerTable,
    AnswerTables,
    shipped_columns,
    tabulate,
)
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import FloatArray, NamedValues

MAX_DISTINCT = 10
"""Maximum number of rows of the table of distinct causes."""
(
    CAUSE_COLUMNS,
    SOLUTION_COLUMNS,
    CHARACTERISTIC_COLUMNS,
    DISTINCT_COLUMNS,
    SMALLEST_COLUMNS,
    STAIRCASE_COLUMNS,
) = shipped_columns("explain").values()
"""The columns of the tables. In the table of characteristics, the interval of a share is the 95 %
interval by Clopper and Pearson if only a sample of the failures was analysed; else both ends are
the share itself.
"""
COUNTS = dict.fromkeys(("holds", "fits", "failing_runs", "runs"), "Int64")
"""The types of columns with whole numbers that may be unknown."""
OF_ENCOUNTER = ("encounter", "elsewhere")
"""Columns that only a study has whose encounters are ranges."""


def failures_frame(
    population: Population, evaluator: Evaluator, reasons: Reasons
) -> pd.DataFrame:
    """The frame with a row of `SOLUTION_COLUMNS` for each chosen failure. `reasons` has the rows of
    the chosen failures, and why each was chosen.
    """
    if not reasons:
        return pd.DataFrame(columns=list(SOLUTION_COLUMNS))

    failures = population.evaluations.take(list(reasons))
    settings = failures.settings
    unsafe = population.unsafe
    sentences, points = zip(
        *compare_at_points(evaluator.system, settings, unsafe), strict=True
    )
    is_assessed = failures.collided & has_reference_drivers(evaluator)
    verdicts = assess_collisions(evaluator, failures.take(is_assessed))
    drivers = np.full(len(failures), None)
    drivers[is_assessed] = list(map(avoided_by, verdicts.to_dict("records")))
    columns = {
        "solution": [population.names[row] for row in reasons],
        "reason": list(reasons.values()),
        "outcome": failures.outcome,
        "safety_degree": failures.f_safe,
        "changed": failures.f_num_diff.astype(int),
        "largest_change": failures.f_diff,
        "unsafe_neighbours": robust_shares(evaluator, settings, unsafe),
        "ends": sentences,
        "points": points,
        "avoided_by": drivers,
    }
    return pd.DataFrame(columns)


def causes_table(
    population: Population,
    evaluator: Evaluator,
    fits: int,
    solutions: pd.DataFrame,
    causes_of: Sequence[Causes],
    distinct: pd.DataFrame,
) -> AnswerTable:
    """The table with a row of `CAUSE_COLUMNS` for each cause of each chosen failure. Robust causes
    come first, the most frequent of them first. All other causes follow, the most robust first.

    Parameters
    ----------
    fits
        Number of parameter sets in which causes are checked.
    solutions
        The frame of the chosen failures.
    causes_of
        The causes of each chosen failure, in the same order.
    distinct
        The distinct causes of the sample, and the share of failures with each of them.
    """
    study = evaluator.study
    unsafe = population.unsafe

    causes = list(chain.from_iterable(causes_of))
    robust, holds, number_of_sets = sureness(evaluator, causes, unsafe, fits)

    limits = find_cause_limits(evaluator, causes, unsafe)
    printed = printed_limits(Model(0, evaluator, unsafe), causes, limits)
    elsewhere = np.zeros(len(causes), dtype=bool)
    if causes and study.ranges:
        at_original = [cause._replace(encounter={}) for cause in causes]
        settings = settings_of(evaluator.characteristics, at_original)
        elsewhere = unsafe.of(
            evaluator.evaluate(settings, "causes in the original encounter")
        )

    share_of = dict(zip(distinct["cause"], distinct["share"], strict=True))
    kinds = [directions(evaluator.characteristics, cause.changes) for cause in causes]
    # Without a sample, no share is known.
    default_share = 0.0 if share_of else np.nan
    shares = [share_of.get(kind, default_share) for kind in kinds]
    is_robust = robust >= MIN_ROBUST_SHARE
    order = np.lexsort([-robust, -np.where(is_robust, shares, 0.0), ~is_robust])
    solution_of = np.repeat(range(len(solutions)), list(map(len, causes_of)))
    rows = [
        {
            **solutions[["solution", "avoided_by"]].iloc[solution_of[index]],
            **causes[index]._asdict(),
            **limits[index]._asdict(),
            **printed[index],
            "size": len(causes[index].changes),
            "elsewhere": elsewhere[index],
            "share": shares[index],
            "robust_share": robust[index],
            "holds": holds[index],
            "fits": number_of_sets,
        }
        for index in order.tolist()
    ]
    frame = pd.DataFrame(rows, columns=list(CAUSE_COLUMNS)).astype(COUNTS)
    frame = with_fresh_runs(evaluator, unsafe, frame, "changes")
    columns = {**CAUSE_COLUMNS}
    for name in () if study.ranges else OF_ENCOUNTER:
        del columns[name]
    title = "Minimal causes: smallest sets of changes that are unsafe"
    is_new = ~frame["boundary"].astype(str).duplicated()
    return tabulate(title, columns, frame, lead_rows=np.flatnonzero(is_new).tolist())


def printed_limits(
    model: Model, causes: Causes, limits: Sequence[Limits]
) -> list[dict[str, NamedValues]]:
    """The columns encounter, boundary and single_boundary of each cause, with values as they are
    printed. Values are rounded to the unsafe side, with so many digits that the vehicle is unsafe.
    """
    pairs = list(zip(causes, limits, strict=True))
    exact = [limit.boundary | cause.encounter for cause, limit in pairs]
    printed = values_as_printed(model, exact)

    # The rounded encounter is used only if the whole, not scaled changes are unsafe in it, too.
    full_changes = [
        values | cause.changes for values, cause in zip(printed, causes, strict=True)
    ]
    members = model.characteristics
    settings = np.array(
        [members.setting(values, beyond=True) for values in full_changes]
    )
    is_unsafe = model.are_unsafe(settings.reshape(-1, len(members)), BOUNDARIES)
    for row in np.flatnonzero(~is_unsafe):
        printed[row] |= exact[row]

    # Round the boundary of each change alone: the other changes are whole, and the encounter is the
    # printed one.
    alone = []
    names = []
    for values, (cause, limit) in zip(printed, pairs, strict=True):
        for name, value in limit.single_boundary.items():
            alone.append(values | cause.changes | {name: value})
            names.append(name)
    single_values = iter(values_as_printed(model, alone, names))
    columns = []
    for values, cause in zip(printed, causes, strict=True):
        columns.append(
            {
                "single_boundary": {
                    name: next(single_values)[name] for name in cause.changes
                },
                "encounter": {name: values[name] for name in cause.encounter},
                "boundary": {name: values[name] for name in cause.changes},
            }
        )
    return columns


def with_fresh_runs(
    evaluator: Evaluator, unsafe: Unsafe, frame: pd.DataFrame, checked: str
) -> pd.DataFrame:
    """The frame of causes with the failing and the fresh runs at the values at which each cause
    begins. Without repeats, the frame stays as it is.

    If no run fails at these values, the cause is told with the values of the column `checked`,
    which are farther from the original. A cause without a failing run there is left out.
    """
    if not evaluator.has_repeats or frame.empty:
        return frame
    rows = frame.to_dict("records")
    _count_failing_runs(evaluator, unsafe, rows)
    unconfirmed = [row for row in rows if not row["failing_runs"]]
    for row in unconfirmed:
        row["boundary"] = row[checked]
    _count_failing_runs(evaluator, unsafe, unconfirmed)
    confirmed = [row for row in rows if row["failing_runs"]]
    return pd.DataFrame(confirmed, columns=list(frame)).astype(COUNTS)


def _count_failing_runs(
    evaluator: Evaluator, unsafe: Unsafe, rows: Sequence[dict[Hashable, Any]]
) -> None:
    """Write the numbers of failing and of fresh runs at the boundary of each cause into its row:
    0 where too few simulations are left.
    """
    members = evaluator.characteristics
    for row in rows:
        row["failing_runs"] = row["runs"] = 0
    chosen = (
        rows if evaluator.settings_left is None else rows[: evaluator.settings_left]
    )
    if not chosen:
        return
    vehicles = [row["boundary"] | (row.get("encounter") or {}) for row in chosen]
    settings = np.array([members.setting(vehicle, beyond=True) for vehicle in vehicles])
    fails = unsafe.failing_runs(evaluator.evaluate_anew(settings))
    for row, of_vehicle in zip(chosen, fails.T, strict=True):
        row["failing_runs"] = of_vehicle.sum()
        row["runs"] = len(of_vehicle)
        row["unsafe_runs"] = of_vehicle.mean()


def sureness(
    evaluator: Evaluator, causes: Causes, unsafe: Unsafe, sets: int
) -> tuple[FloatArray, list[int | None], int | None]:
    """How sure M causes are. The results are:

    - the unsafe share of vehicles with nearly the values of each cause, shape (M,),
    - for each cause, the number of the first `sets` parameter sets in which it is a cause,
    - the number of these sets.

    The second and third result are None if no other parameter set is checked.
    """
    robust = np.full(len(causes), np.nan)
    if causes:
        settings = settings_of(evaluator.characteristics, causes)
        robust = robust_shares(evaluator, settings, unsafe)
    if not (sets and causes and evaluator.study.spread):
        return robust, [None] * len(causes), None
    studies = studies_of_sets(evaluator.study)[:sets]
    with evaluator.phases.stage(
        OTHER_SETS, len(studies) * sum(1 + len(cause.changes) for cause in causes)
    ):
        are_one = [
            are_causes(evaluator.for_study(study, verified=0), causes, unsafe)
            for study in studies
        ]
    return robust, np.sum(are_one, axis=0).tolist(), len(studies)


def statistics_tables(
    necessity: pd.DataFrame,
    failures: int,
    verdicts: pd.DataFrame,
    collisions: int,
    distinct: pd.DataFrame,
) -> AnswerTables:
    """The tables of characteristics, of drivers and of distinct causes, by name.

    Parameters
    ----------
    necessity
        How often each characteristic is changed and needed (`count_needed`).
    failures
        Number of analysed failures.
    verdicts
        For each examined collision, whether each driver avoids it.
    collisions
        Number of all collisions.
    distinct
        The distinct causes (`count_distinct_causes`).
    """
    return {
        "characteristics": tabulate(
            "How often each characteristic is changed, and how often it is necessary, in"
            f" {number_of(failures, 'failure')}",
            CHARACTERISTIC_COLUMNS,
            # With a single failure every share is 0 or 1: the table would say nothing.
            necessity if failures > 1 else necessity.head(0),
        ),
        "drivers": tabulate(
            "What other drivers would have avoided in the same vehicle:"
            f" {number_of(len(verdicts), 'collision')} simulated again",
            DRIVER_COLUMNS,
            drivers_frame(verdicts, collisions),
        ),
        "distinct_causes": tabulate(
            f"The most frequent of {number_of(len(distinct), 'different cause')}",
            DISTINCT_COLUMNS,
            distinct.assign(cause=distinct["cause"].map(", ".join)).head(MAX_DISTINCT),
        ),
    }
