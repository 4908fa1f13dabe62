"""Explains failures: the changes that cause them, how small a change is enough, the reason in words, and the
robustness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator, open_evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare_braking, summarise_run
from safevar_sumo.analysis.explain.causes import (
    Boundary,
    MinimalCause,
    find_boundaries,
    find_minimal_causes,
    select_affordable_rows,
    shorten,
)
from safevar_sumo.analysis.explain.necessity import cause_key, count_distinct_causes, necessity_frame
from safevar_sumo.analysis.explain.result import Cause, Explained, Explanation
from safevar_sumo.analysis.explain.robustness import (
    STEP_FACTORS,
    Robustness,
    estimate_robustness,
    find_smallest_robust_failure,
)
from safevar_sumo.analysis.explain.sentences import DISTINCT_CAUSE, REASONS, ROBUST
from safevar_sumo.analysis.preventability import assess_preventability, classify_collisions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.protocol.points import UNKNOWN as UNKNOWN_COLOUR
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, handles_of, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import PointResult, simulate, simulate_all_points, worst_points
from safevar_sumo.sumo.system import System, assemble

CausesByRow = Mapping[int, list[MinimalCause]]
"""The minimal causes of settings, by the setting's row."""
Reasons = dict[int, tuple[str, ...]]
"""The rows of the chosen failures, with the reasons for their choice."""
SAMPLED_SETTINGS, RATED_SAMPLED_SETTINGS = 4096, 64
"""Number of settings drawn from the whole domain if there are no results, in an unrated and in a rated study."""


def explain_failures(
    source: Study | Case,
    options: ExplainOptions,
    *,
    pool: Pool | None = None,
    jobs: int | None = None,
    progress: Progress = show_no_progress,
    statistics: bool = True,
) -> Explained:
    """Explain the failures that matter among the solutions of results, or among settings drawn from a study's whole
    domain.

    Without `statistics`, only the failures that matter by their size or severity, and nothing of all the others.

    Raises
    ------
    InputError
        If `unsafe` or a handle cannot be read, a handle is no solution of the results, or the study cannot be
        assembled.
    """
    study = study_in(source)
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        unsafe = None if options.unsafe is None else evaluator.parse_criterion(options.unsafe)
        original = evaluator.evaluate_original()
        found = _evaluate(source, options, evaluator, original, unsafe)
        limit = options.limit // len(assemble(study).points)  # an evaluation simulates a setting at every point
        settings, characteristics = found.evaluations.settings, evaluator.characteristics
        sample = (
            found.rows
            if options.solutions
            else []
            if not statistics
            else [found.rows[index] for index in select_affordable_rows(settings[found.rows], evaluator, limit)]
        )
        requested: Reasons = {row: ("requested",) for row in found.rows}
        reasons = requested if options.solutions else _choose_rows(found, evaluator, original, limit)
        analysed = sorted({*sample, *reasons})
        causes = dict(zip(analysed, find_minimal_causes(evaluator, settings[analysed], found.unsafe), strict=True))
        if not options.solutions:
            reasons = _add_distinct_causes(found, evaluator, sample, reasons, causes, options.top)
        explanations = _explain_rows(found, evaluator, original, causes, reasons)
        preventable = assess_preventability(evaluator, _collisions(study, found.evaluations))
        no_verdict = evaluator.no_verdict
    sample_causes, changed = [causes[row] for row in sample], characteristics.changed(settings[sample])
    nearest = np.argsort(found.evaluations.f_safe, kind="stable")[:1]
    return Explained(
        study=study,
        unsafe=found.unsafe,
        original=original,
        nearest=found.evaluations.take(nearest),
        explanations=explanations,
        necessity=necessity_frame(characteristics, changed, sample_causes, len(found.rows)),
        distinct=count_distinct_causes(characteristics, sample_causes),
        looked_at=len(found.evaluations),
        failures=len(found.rows),
        analysed=len(sample),
        otherwise=found.deviations,
        preventability=preventable,
        no_verdict=no_verdict,
    )


class _Found(NamedTuple):
    """Evaluated settings, safe ones too, and the rows to explain: the unsafe ones, or those that the options name.

    Equal solutions of several runs are one row. `handles` are None for settings that are no solutions; `deviations`
    counts settings whose outcome differs from that in the results.
    """

    evaluations: Evaluations
    handles: list[SolutionId | None]
    unsafe: Unsafe
    rows: list[int]
    deviations: int


def _evaluate(
    source: Study | Case, options: ExplainOptions, evaluator: Evaluator, original: Evaluations, unsafe: Unsafe | None
) -> _Found:
    """Evaluate all solutions of results, or settings drawn from a study's whole domain."""
    named = [SolutionId.parse(text, "solutions") for text in options.solutions]
    handles: list[SolutionId | None]
    if isinstance(source, Study):
        if named:
            raise InputError("solutions", f"{source.name!r} is a study and has no solutions", "a results directory")
        number = RATED_SAMPLED_SETTINGS if is_rated(source) else SAMPLED_SETTINGS
        settings = evaluator.characteristics.filter(
            evaluator.feasible_settings(number, source.search.seed, feasible_after_filter=True)
        )
        handles, recorded = [None] * len(settings), np.full(len(settings), UNKNOWN)
    else:
        solutions, names = source.solutions, list(evaluator.characteristics.names)
        distinct = solutions[~solutions.duplicated(names)].index.tolist()
        named_rows = [row_of_handle(solutions, handle, "solutions") for handle in named]
        rows = list(dict.fromkeys([*named_rows, *distinct]))  # the named ones first
        settings, all_handles = solutions[names].to_numpy(dtype=float)[rows], handles_of(solutions)
        handles, recorded = [all_handles[row] for row in rows], solutions["outcome"].to_numpy(dtype=str)[rows]
    evaluations = evaluator.evaluate(settings, "settings to explain")
    criterion = unsafe or Unsafe.default_among(evaluations, original)
    rows = list(range(len(set(named)))) if named else np.flatnonzero(criterion.of(evaluations)).tolist()
    deviations = int(np.count_nonzero((evaluations.outcome != recorded) & (recorded != UNKNOWN)))
    return _Found(evaluations, handles, criterion, rows, deviations)


def _collisions(study: Study, evaluations: Evaluations) -> Evaluations:
    """The collisions whose preventability is assessed; none in a rated study, where every vehicle collides in some
    cell.
    """
    return evaluations.take(evaluations.collided & (not is_rated(study)))


def _choose_rows(found: _Found, evaluator: Evaluator, original: Evaluations, limit: int) -> Reasons:
    """Choose the failures that are smallest robust, of the fewest changes, most severe, and of the smallest changes."""
    reasons: Reasons = {}
    candidates = found.evaluations.take(found.rows)
    if found.rows and not is_rated(evaluator.study) and not found.unsafe.of(original)[0]:
        step = _time_step(assemble(evaluator.study))
        index = find_smallest_robust_failure(evaluator, candidates, step, found.unsafe, limit)
        reasons = {} if index is None else {found.rows[index]: (ROBUST,)}
    for choice in ("fewest", "most_severe", "smallest") if found.rows else ():
        order = np.lexsort([getattr(candidates, name) for name in reversed(CHOICES[choice])])
        row = found.rows[int(order[0])]
        reasons[row] = (*reasons.get(row, ()), REASONS[choice])
    return reasons


def _add_distinct_causes(
    found: _Found, evaluator: Evaluator, sample: Sequence[int], reasons: Reasons, causes: CausesByRow, top: int
) -> Reasons:
    """Add the simplest failure of every minimal cause that no chosen failure has, until `top` failures are chosen."""
    chosen = dict(list(reasons.items())[:top])
    keys = {
        row: {cause_key(evaluator.characteristics, cause) for cause in row_causes} for row, row_causes in causes.items()
    }
    for key in count_distinct_causes(evaluator.characteristics, [causes[row] for row in sample])["cause"]:
        if len(chosen) >= top:
            break
        if not any(key in keys[row] for row in chosen):
            sizes = found.evaluations.f_num_diff, found.evaluations.f_diff
            simplest = min(
                (row for row in sample if key in keys[row]), key=lambda row: (*(size[row] for size in sizes), row)
            )
            chosen[simplest] = (DISTINCT_CAUSE,)
    return chosen


def _explain_rows(
    found: _Found, evaluator: Evaluator, original: Evaluations, causes: CausesByRow, reasons: Reasons
) -> tuple[Explanation, ...]:
    """Explanations of the chosen failures."""
    rows, unsafe, system = list(reasons), found.unsafe, assemble(evaluator.study)
    if not rows:
        return ()
    chosen, names = found.evaluations.take(rows), evaluator.characteristics.names
    all_causes = [cause for row in rows for cause in causes[row]]
    if is_rated(evaluator.study):  # each neighbour is simulated in all cells, which takes too long for all causes
        comparisons = compare_at_cells(evaluator, original.settings, chosen.settings)
        robustnesses = estimate_robustness(evaluator, chosen.settings, _time_step(system), unsafe, STEP_FACTORS[:1])
    else:
        comparisons = compare_at_points(system, original.settings, chosen.settings, unsafe)
        settings = np.array([*chosen.settings, *(cause.setting for cause in all_causes)])
        robustnesses = estimate_robustness(evaluator, settings, _time_step(system), unsafe)
    boundaries = find_boundaries(evaluator, all_causes, unsafe)
    exact = np.array([one.setting for ones in (all_causes, boundaries) for one in ones]).reshape(-1, len(names))
    short = exact if is_rated(evaluator.study) or not len(exact) else shorten(evaluator, exact, unsafe)
    described = iter(
        [
            _describe_cause(names, *parts)
            for parts in zip_longest(all_causes, boundaries, *np.split(short, 2), robustnesses[len(rows) :])
        ]
    )
    collisions = _collisions(evaluator.study, chosen)
    avoidances = dict(zip(map(bytes, collisions.settings), classify_collisions(evaluator, collisions), strict=True))
    explanations = list[Explanation]()
    for row, setting, comparison, robustness in zip(rows, chosen.settings, comparisons, robustnesses, strict=False):
        avoidance, index = avoidances.get(bytes(setting)), len(explanations)
        changed = evaluator.characteristics.changed(setting)
        explanations.append(
            Explanation(
                handle=found.handles[row],
                reasons=reasons[row],
                setting=dict(zip(names, setting.tolist(), strict=True)),
                outcome=str(chosen.outcome[index]),
                safety_degree=finite_or_none(chosen.f_safe[index]),
                changed=tuple(name for name, is_changed in zip(names, changed, strict=True) if is_changed),
                causes=tuple(next(described) for _ in causes[row]),
                robustness=robustness,
                because=comparison.braking,
                points=comparison.failing_points,
                preventable=str(avoidance.by) if avoidance else "",
            )
        )
    return tuple(explanations)


def _describe_cause(
    names: Sequence[str],
    cause: MinimalCause,
    boundary: Boundary,
    short_changes: FloatArray,
    short_boundary: FloatArray,
    robustness: Robustness | None,
) -> Cause:
    def values(setting: FloatArray) -> dict[str, float]:
        return {names[column]: float(setting[column]) for column in cause.columns}

    return Cause(
        changes=values(cause.setting),
        boundary=values(boundary.setting),
        fraction=boundary.fraction,
        short_changes=values(short_changes),
        short_boundary=values(short_boundary),
        alone={names[column]: value for column, value in boundary.single_limits.items()},
        outcome=cause.outcome,
        safety_degree=cause.safety_degree,
        end=boundary.state_below,
        neighbours=robustness,
        at_threshold=None if boundary.at_threshold is None else names[boundary.at_threshold],
    )


def _time_step(system: System) -> float:
    """The time step of the simulations [s]."""
    return simulate(
        system.at(system.points[0]) if system.matrix else system, system.characteristics.original[np.newaxis]
    ).trace.step


class PointComparison(NamedTuple):
    """One failure at the test points of a study.

    Attributes
    ----------
    braking
        Comparison of the original vehicle with the failure at the failure's worst point.
    failing_points
        Names of the points of a test matrix at which the failure is unsafe; in a rated study, of the cells whose colour
        is worse than the original's. In the study's order.
    """

    braking: BrakingComparison
    failing_points: tuple[str, ...]


def compare_at_points(
    system: System, original: FloatArray, settings: FloatArray, unsafe: Unsafe
) -> list[PointComparison]:
    """Compare settings, shape (M, n), with the original, shape (1, n)."""
    point_results = simulate_all_points(system, np.concatenate([original, settings]))
    failing_points, worst = unsafe_points_of(system, point_results, unsafe)[1:], worst_points(point_results)[1:]
    return [
        PointComparison(_compare_runs(point_results[index], row, point_results[index].point.name), names)
        for row, (names, index) in enumerate(zip(failing_points, worst.tolist(), strict=True), 1)
    ]


def compare_at_cells(evaluator: Evaluator, original: FloatArray, settings: FloatArray) -> list[PointComparison]:
    """As `compare_at_points`, for a rated study: finds the cells whose colour is worse; compares in the worst cell.

    An unknown colour is neither better nor worse.
    """
    system = assemble(evaluator.study)
    assert system.rater is not None
    stage = "cells whose colour is worse"
    colours = system.rater.points(evaluator.simulate_cells(np.concatenate([original, settings]), stage)).colours.astype(
        int
    )
    losses = np.where(colours[0] == UNKNOWN_COLOUR, 0, np.maximum(colours[1:] - colours[0], 0))
    comparisons = []
    for setting, loss in zip(settings, losses, strict=True):
        point = system.matrix[int(np.argmax(loss))]
        (worst,) = simulate_all_points(system.at(point), np.concatenate([original, setting[np.newaxis]]))
        worse_cells = tuple(system.matrix[index].name for index in np.flatnonzero(loss).tolist())
        comparisons.append(PointComparison(_compare_runs(worst, 1, point.name), worse_cells))
    return comparisons


def _compare_runs(result: PointResult, row: int, point: str) -> BrakingComparison:
    """Compare the original vehicle, setting 0 of a result, with the setting in `row`, at the test point named
    `point`.
    """
    original_run, changed_run = (summarise_run(result.runs, k, float(result.evaluations.f_safe[k])) for k in (0, row))
    return compare_braking(original_run, changed_run, point)


def unsafe_points_of(system: System, point_results: list[PointResult], unsafe: Unsafe) -> list[tuple[str, ...]]:
    """Names of the points of the test matrix at which each setting is unsafe; empty without a test matrix."""
    if not system.matrix:
        return [() for _ in point_results[0].evaluations.settings]
    unsafe_by_point = np.stack([unsafe.of(result.evaluations) for result in point_results])
    return [
        tuple(result.point.name for result, is_unsafe in zip(point_results, flags, strict=True) if is_unsafe)
        for flags in unsafe_by_point.T
    ]
