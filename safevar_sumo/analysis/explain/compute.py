"""Explains failures: the changes that cause them, how small a change is enough, the reason in words, and the robustness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator, open_evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare_braking, summarise_run
from safevar_sumo.analysis.explain.causes import (
    MinimalCause,
    find_boundaries,
    find_minimal_causes,
    necessary_columns,
    select_affordable_rows,
    shorten,
)
from safevar_sumo.analysis.explain.necessity import cause_key, count_distinct_causes, necessity_frame
from safevar_sumo.analysis.explain.result import DISTINCT_CAUSE, REASONS, ROBUST, Cause, Explained, Explanation
from safevar_sumo.analysis.explain.robustness import STEP_FACTORS, estimate_robustness, find_smallest_robust_failure
from safevar_sumo.analysis.preventability import assess_preventability, classify_collisions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.protocol.points import UNKNOWN as UNKNOWN_COLOUR
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, handles_of, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import PointResult, simulate_all_points, worst_points
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.evaluation import Pool

CausesByRow = Mapping[int, list[MinimalCause]]
"""The minimal causes of settings, by the setting's row."""
ChoiceReasons = tuple[str, ...]
"""Why a failure was chosen to be explained."""
SAMPLED_SETTINGS, RATED_SAMPLED_SETTINGS = 4096, 64
"""Number of settings drawn from the whole domain if there are no results, in an unrated and in a rated study."""


class EvaluatedSettings(NamedTuple):
    """Evaluated settings, safe ones too, and the rows of those to explain.

    Attributes
    ----------
    evaluations
        Evaluations of filtered settings; equal solutions of several runs are one row.
    handles
        Handle of each setting's solution; None for a setting that is no solution.
    unsafe
        The criterion.
    rows_to_explain
        The unsafe settings, or the solutions that the options name, unsafe or not.
    deviations
        Number of settings whose outcome differs from the outcome in the results.
    """

    evaluations: Evaluations
    handles: list[SolutionId | None]
    unsafe: Unsafe
    rows_to_explain: list[int]
    deviations: int

    def row_of(self, choice: str) -> int:
        """The row to explain that comes first in the order of one of `CHOICES`, such as "fewest"."""
        candidates = self.evaluations.take(self.rows_to_explain)
        return self.rows_to_explain[int(np.lexsort([getattr(candidates, name) for name in reversed(CHOICES[choice])])[0])]


def evaluate_source(source: Study | Case, evaluator: Evaluator, original: Evaluations, named_solutions: Sequence[SolutionId],
                    unsafe: Unsafe | None) -> EvaluatedSettings:
    """Evaluate all solutions of results (a `Case`), or settings drawn from a study's whole domain.

    Raises
    ------
    InputError
        If a handle in `named_solutions` is no solution of the results.
    """
    if isinstance(source, Study):
        if named_solutions:
            raise InputError("solutions", f"{source.name!r} is a study and has no solutions", "a results directory")
        number = RATED_SAMPLED_SETTINGS if is_rated(source) else SAMPLED_SETTINGS
        settings = evaluator.characteristics.filter(evaluator.feasible_settings(number, source.search.seed, feasible_after_filter=True))
        solution_handles: list[SolutionId | None] = [None] * len(settings)
        recorded_outcomes = None
        rows_to_explain = None
    else:
        solutions = source.solutions
        all_handles, all_settings = handles_of(solutions), solutions[list(evaluator.characteristics.names)].to_numpy(dtype=float)
        named_rows = list(dict.fromkeys(row_of_handle(solutions, handle, "solutions") for handle in named_solutions))
        ordered_rows = [*named_rows, *(row for row in _distinct_rows(all_settings) if row not in set(named_rows))]  # the named ones first
        settings, solution_handles = all_settings[ordered_rows], [all_handles[row] for row in ordered_rows]
        recorded_outcomes = solutions["outcome"].to_numpy(dtype=str)[ordered_rows]
        rows_to_explain = list(range(len(named_rows))) if named_solutions else None
    evaluations = evaluator.evaluate(settings, "settings to explain")
    criterion = unsafe or Unsafe.default_among(evaluations, original)
    if rows_to_explain is None:
        rows_to_explain = np.flatnonzero(criterion.of(evaluations)).tolist()
    deviations = 0 if recorded_outcomes is None else int(
        np.count_nonzero((evaluations.outcome != recorded_outcomes) & (recorded_outcomes != UNKNOWN)))
    return EvaluatedSettings(evaluations, solution_handles, criterion, rows_to_explain, deviations)


def _distinct_rows(settings: np.ndarray) -> list[int]:
    """The first row of every distinct setting, in the order of the rows."""
    return sorted(np.unique(settings, axis=0, return_index=True)[1].tolist())


class PointComparison(NamedTuple):
    """One failure at the test points of a study.

    Attributes
    ----------
    braking
        Comparison of the original vehicle with the failure at the failure's worst point.
    failing_points
        Names of the points of a test matrix at which the failure is unsafe; in a rated study, of the cells whose colour is worse than the
        original's. In the study's order.
    """

    braking: BrakingComparison
    failing_points: tuple[str, ...]


def compare_at_points(system: System, original: FloatArray, settings: FloatArray, unsafe: Unsafe) -> tuple[list[PointComparison], float]:
    """Compare settings, shape (M, n), with the original, shape (1, n); also returns the time step of the simulations [s]."""
    point_results = simulate_all_points(system, np.concatenate([original, settings]))
    failing_points, worst = unsafe_points_of(system, point_results, unsafe)[1:], worst_points(point_results)[1:]
    worst_results = [point_results[index] for index in worst.tolist()]
    comparisons = [PointComparison(_compare_runs(result, row, result.point.name), names)
                   for row, (names, result) in enumerate(zip(failing_points, worst_results, strict=True), 1)]
    return comparisons, point_results[0].runs.trace.step


def _compare_runs(result: PointResult, row: int, point: str) -> BrakingComparison:
    """Compare the original vehicle, setting 0 of a result, with the setting in `row`, at the test point named `point`."""
    original_run, changed_run = (summarise_run(result.runs, k, float(result.evaluations.f_safe[k])) for k in (0, row))
    return compare_braking(original_run, changed_run, point)


def compare_at_cells(evaluator: Evaluator, original: FloatArray, settings: FloatArray) -> tuple[list[PointComparison], float]:
    """As `compare_at_points`, for a rated study: finds the cells whose colour is worse than the original's; compares in the worst cell.

    An unknown colour is neither better nor worse.
    """
    system = assemble(evaluator.study)
    assert system.rater is not None
    rating = system.rater.points(evaluator.simulate_cells(np.concatenate([original, settings]), "cells whose colour is worse"))
    colours = rating.colours.astype(int)
    comparisons: list[PointComparison] = []
    step = 0.0
    for row in range(1, len(colours)):
        colour_loss = np.where(colours[0] == UNKNOWN_COLOUR, 0, np.maximum(colours[row] - colours[0], 0))
        point = system.matrix[int(np.argmax(colour_loss))]
        (worst_result,) = simulate_all_points(system.at(point), np.concatenate([original, settings[row - 1:row]]))
        worse_cells = tuple(system.matrix[k].name for k in np.flatnonzero(colour_loss).tolist())
        comparisons.append(PointComparison(_compare_runs(worst_result, 1, point.name), worse_cells))
        step = worst_result.runs.trace.step
    return comparisons, step


def unsafe_points_of(system: System, point_results: list[PointResult], unsafe: Unsafe) -> list[tuple[str, ...]]:
    """Names of the points of the test matrix at which each setting is unsafe; empty without a test matrix."""
    if not system.matrix:
        return [() for _ in point_results[0].evaluations.settings]
    unsafe_by_point = np.stack([unsafe.of(result.evaluations) for result in point_results])
    return [tuple(result.point.name for result, is_unsafe in zip(point_results, flags, strict=True) if is_unsafe)
            for flags in unsafe_by_point.T]


class FailureSelection(NamedTuple):
    """The failures to explain, of a study or of results, with their minimal causes.

    Attributes
    ----------
    sample
        The rows that were analysed: all rows to explain, or a random sample of them.
    causes
        The minimal causes of the sample and of the chosen failures.
    choice_reasons
        The rows of the chosen failures, with the reasons for their choice.
    """

    original: Evaluations
    evaluated: EvaluatedSettings
    sample: list[int]
    causes: CausesByRow
    choice_reasons: Mapping[int, ChoiceReasons]


def choose_failures(source: Study | Case, options: ExplainOptions, evaluator: Evaluator) -> FailureSelection:
    """Choose the failures that the options name, or the failures that matter.

    Raises
    ------
    InputError
        If `unsafe` or a handle cannot be read, or a handle is no solution of the results.
    """
    unsafe = None if options.unsafe is None else evaluator.parse_criterion(options.unsafe)
    named_solutions = [SolutionId.parse(text, "solutions") for text in options.solutions]
    max_evaluations = options.limit // len(assemble(evaluator.study).points)  # an evaluation simulates a setting at every point
    original = evaluator.evaluate_original()
    evaluated = evaluate_source(source, evaluator, original, named_solutions, unsafe)
    settings, rows = evaluated.evaluations.settings, evaluated.rows_to_explain
    sample = rows if named_solutions else [rows[i] for i in select_affordable_rows(settings[rows], evaluator, max_evaluations)]
    robust_row = None if named_solutions or is_rated(evaluator.study) else _find_robust_row(evaluated, evaluator, original, max_evaluations)
    choice_reasons = dict.fromkeys(rows, ("requested",)) if named_solutions else _choose_rows(evaluated, robust_row)
    analysed_rows = sorted({*sample, *choice_reasons})
    causes = dict(zip(analysed_rows, find_minimal_causes(evaluator, settings[analysed_rows], evaluated.unsafe), strict=True))
    if not named_solutions:
        choice_reasons = _add_distinct_causes(evaluated, evaluator, sample, choice_reasons, causes, options.top)
    return FailureSelection(original, evaluated, sample, causes, choice_reasons)


def explain_failures(source: Study | Case, options: ExplainOptions, *, pool: Pool | None = None, jobs: int | None = None,
                     progress: Progress = show_no_progress) -> Explained:
    """Explain the failures that matter among the solutions of results, or among settings drawn from a study's whole domain.

    Raises
    ------
    InputError
        As `choose_failures`, or if the study cannot be assembled.
    """
    study = source if isinstance(source, Study) else source.study
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        original, evaluated, sample, causes, choice_reasons = choose_failures(source, options, evaluator)
        settings = evaluated.evaluations.settings
        explanations = _explain_rows(evaluated, evaluator, original, causes, choice_reasons)
        collisions = evaluated.evaluations.take(_collisions_to_classify(study, evaluated.evaluations))
        preventable = assess_preventability(evaluator, collisions)
        no_verdict = evaluator.no_verdict
    sample_causes, characteristics = [causes[row] for row in sample], evaluator.characteristics
    changed = characteristics.changed(settings[sample])
    return Explained(
        study=study, unsafe=evaluated.unsafe, original=original, explanations=explanations,
        necessity=necessity_frame(characteristics, changed, sample_causes, len(evaluated.rows_to_explain)),
        distinct=count_distinct_causes(characteristics, sample_causes), looked_at=len(evaluated.evaluations),
        failures=len(evaluated.rows_to_explain), analysed=len(sample), otherwise=evaluated.deviations, preventability=preventable,
        no_verdict=no_verdict)


def _collisions_to_classify(study: Study, evaluations: Evaluations) -> BoolArray:
    """The collisions whose preventability is assessed; none in a rated study, where every vehicle collides in some cell."""
    return np.asarray(evaluations.collided & (not is_rated(study)))


def _find_robust_row(evaluated: EvaluatedSettings, evaluator: Evaluator, original: Evaluations, max_evaluations: int) -> int | None:
    """Row of the smallest robust failure found within the limit; None without such a failure, or if the original vehicle is unsafe."""
    rows, unsafe = evaluated.rows_to_explain, evaluated.unsafe
    if not rows or unsafe.of(original)[0]:
        return None
    _, step = compare_at_points(assemble(evaluator.study), original.settings, original.settings[:0], unsafe)  # only for the time step
    index = find_smallest_robust_failure(evaluator, evaluated.evaluations.take(rows), step, unsafe, max_evaluations)
    return None if index is None else rows[index]


def _choose_rows(evaluated: EvaluatedSettings, robust_row: int | None) -> dict[int, ChoiceReasons]:
    """Choose the failures that are smallest robust, of the fewest changes, most severe, and of the smallest changes."""
    reasons: dict[int, ChoiceReasons] = {} if robust_row is None else {robust_row: (ROBUST,)}
    for choice in ("fewest", "most_severe", "smallest"):
        if evaluated.rows_to_explain:
            row = evaluated.row_of(choice)
            reasons[row] = (*reasons.get(row, ()), REASONS[choice])
    return reasons


def _add_distinct_causes(evaluated: EvaluatedSettings, evaluator: Evaluator, sample: Sequence[int],
                         choice_reasons: Mapping[int, ChoiceReasons], causes: CausesByRow, top: int) -> dict[int, ChoiceReasons]:
    """Add the simplest failure of every minimal cause that no chosen failure has, until `top` failures are chosen."""
    chosen = dict(list(choice_reasons.items())[:top])
    keys = {row: {cause_key(evaluator.characteristics, cause) for cause in row_causes} for row, row_causes in causes.items()}
    for key in count_distinct_causes(evaluator.characteristics, [causes[row] for row in sample])["cause"]:
        if len(chosen) >= top:
            break
        if not any(key in keys[row] for row in chosen):
            candidates = [row for row in sample if key in keys[row]]
            simplest = min(candidates, key=lambda row: (evaluated.evaluations.f_num_diff[row], evaluated.evaluations.f_diff[row], row))
            chosen[simplest] = (DISTINCT_CAUSE,)
    return chosen


def _explain_rows(evaluated: EvaluatedSettings, evaluator: Evaluator, original: Evaluations, causes: CausesByRow,
                  choice_reasons: Mapping[int, ChoiceReasons]) -> tuple[Explanation, ...]:
    """Explanations of the chosen failures."""
    if not choice_reasons:
        return ()
    rows, unsafe = list(choice_reasons), evaluated.unsafe
    chosen, names = evaluated.evaluations.take(rows), evaluator.characteristics.names
    all_causes = [cause for row in rows for cause in causes[row]]
    if is_rated(evaluator.study):  # each neighbour is simulated in all cells, which takes too long for all causes
        comparisons, step = compare_at_cells(evaluator, original.settings, chosen.settings)
        robustnesses = estimate_robustness(evaluator, chosen.settings, step, unsafe, STEP_FACTORS[:1])
    else:
        comparisons, step = compare_at_points(assemble(evaluator.study), original.settings, chosen.settings, unsafe)
        settings = np.array([*chosen.settings, *(cause.setting for cause in all_causes)])
        robustnesses = estimate_robustness(evaluator, settings, step, unsafe)
    boundaries = find_boundaries(evaluator, all_causes, unsafe)
    exact = [one.setting for both in zip(all_causes, boundaries, strict=True) for one in both]
    short = iter(shorten(evaluator, np.array(exact), unsafe) if exact and not is_rated(evaluator.study) else exact)
    boundary_of_next, cause_robustnesses = iter(boundaries), iter(robustnesses[len(rows):])
    collision_indices = np.flatnonzero(_collisions_to_classify(evaluator.study, chosen))
    classified = classify_collisions(evaluator, chosen.take(collision_indices))
    avoidances = dict(zip(collision_indices.tolist(), classified, strict=True))
    explanations = []
    for i, row in enumerate(rows):
        described_causes = []
        for cause in causes[row]:
            boundary, columns = next(boundary_of_next), cause.columns
            short_changes, short_boundary = ({names[column]: float(next_short[column]) for column in columns}
                                             for next_short in (next(short), next(short)))
            described_causes.append(Cause(
                changes={names[column]: float(cause.setting[column]) for column in cause.columns},
                boundary={names[column]: float(boundary.setting[column]) for column in cause.columns}, fraction=boundary.fraction,
                alone={names[column]: value for column, value in boundary.single_limits.items()}, outcome=cause.outcome,
                safety_degree=cause.safety_degree, end=boundary.state_below,
                at_threshold=None if boundary.at_threshold is None else names[boundary.at_threshold],
                neighbours=next(cause_robustnesses, None), short_changes=short_changes, short_boundary=short_boundary))
        changed = evaluator.characteristics.changed(chosen.settings[i])
        explanations.append(Explanation(
            handle=evaluated.handles[row], reasons=choice_reasons[row], setting=dict(zip(names, chosen.settings[i].tolist(), strict=True)),
            outcome=str(chosen.outcome[i]), safety_degree=finite_or_none(chosen.f_safe[i]),
            changed=tuple(name for name, is_changed in zip(names, changed, strict=True) if is_changed),
            necessary=tuple(names[column] for column in sorted(necessary_columns(causes[row]))), causes=tuple(described_causes),
            robustness=robustnesses[i], because=comparisons[i].braking, points=comparisons[i].failing_points,
            preventable=str(avoidance.by) if (avoidance := avoidances.get(i)) else ""))
    return tuple(explanations)
