"""Explains failures: the changes that cause them, how small a change is enough, the reason in words, and the robustness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator, Progress, open_evaluator, show_no_progress
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare_braking, summarise_run
from safevar_sumo.analysis.explain.causes import (
    MinimalCause,
    find_boundaries,
    find_minimal_causes,
    necessary_columns,
    select_affordable_rows,
)
from safevar_sumo.analysis.explain.necessity import (
    STEP_FACTORS,
    cause_key,
    count_distinct_causes,
    estimate_robustness,
    find_smallest_robust_failure,
    necessity_frame,
)
from safevar_sumo.analysis.explain.result import REASONS, ROBUST, Cause, Explained, Explanation
from safevar_sumo.analysis.preventability import assess_preventability, classify_collisions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.points import UNKNOWN as UNKNOWN_COLOUR
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, handles_of, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import PointResult, simulate_all_points, worst_points
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.evaluation import Pool

Causes = Mapping[int, list[MinimalCause]]
"""Minimal causes by row."""
Reasons = tuple[str, ...]
SEARCH_SETTINGS, RATED_SEARCH_SETTINGS = 4096, 64
"""Number of settings over the whole domain that are searched for failures if there are no results; without and with a rating."""


class Failures(NamedTuple):
    """Evaluated settings, and the rows of the settings to explain.

    Attributes
    ----------
    evaluations
        Evaluations of filtered settings; equal solutions of several runs are one row.
    handles
        Handle of each setting's solution; None for a setting that is no solution.
    unsafe
        The criterion.
    rows
        Rows to explain: the unsafe settings, or the solutions that the options name.
    deviations
        Number of settings whose outcome differs from the outcome in the results.
    """

    evaluations: Evaluations
    handles: list[SolutionId | None]
    unsafe: Unsafe
    rows: list[int]
    deviations: int

    def row_of(self, choice: str) -> int:
        """The row that the choice fewest, smallest or most_severe selects (`CHOICES`)."""
        candidates = self.evaluations.take(self.rows)
        return self.rows[int(np.lexsort([getattr(candidates, name) for name in reversed(CHOICES[choice])])[0])]


def find_failures(source: Study | Case, evaluator: Evaluator, original: Evaluations, named_solutions: Sequence[SolutionId],
                  unsafe: Unsafe | None) -> Failures:
    """Evaluate all solutions of results, or settings all over a study's domain.

    Raises
    ------
    InputError
        If a handle in `named_solutions` is no solution of the results.
    """
    if isinstance(source, Study):
        if named_solutions:
            raise InputError("solutions", f"{source.name!r} is a study and has no solutions", "a results directory")
        number = RATED_SEARCH_SETTINGS if is_rated(source) else SEARCH_SETTINGS
        settings = evaluator.characteristics.filter(evaluator.feasible_settings(number, source.search.seed, filtered=True))
        solution_handles: list[SolutionId | None] = [None] * len(settings)
        recorded_outcomes = None
        rows = None
    else:
        solutions = source.solutions
        all_handles, all_settings = handles_of(solutions), solutions[list(evaluator.characteristics.names)].to_numpy(dtype=float)
        named_rows = list(dict.fromkeys(row_of_handle(solutions, handle, "solutions") for handle in named_solutions))
        chosen_rows = [*named_rows, *(row for row in _distinct_rows(all_settings) if row not in set(named_rows))]
        settings, solution_handles = all_settings[chosen_rows], [all_handles[row] for row in chosen_rows]
        recorded_outcomes = solutions["outcome"].to_numpy(dtype=str)[chosen_rows]
        rows = list(range(len(named_rows))) if named_solutions else None
    evaluations = evaluator.evaluate(settings, "settings to explain")
    criterion = unsafe or Unsafe.default_among(evaluations, original)
    if rows is None:
        rows = np.flatnonzero(criterion.of(evaluations)).tolist()
    deviations = 0 if recorded_outcomes is None else int(
        np.count_nonzero((evaluations.outcome != recorded_outcomes) & (recorded_outcomes != UNKNOWN)))
    return Failures(evaluations, solution_handles, criterion, rows, deviations)


def _distinct_rows(settings: np.ndarray) -> list[int]:
    """The first row of every distinct setting, in the order of the rows."""
    return sorted(np.unique(settings, axis=0, return_index=True)[1].tolist())


MAX_POINTS_NAMED = 6
"""Maximum number of failing points that a sentence names."""


class PointComparison(NamedTuple):
    """One failure at the points of a study.

    Attributes
    ----------
    because
        Comparison of the original vehicle with the failure at the failure's worst point.
    points
        Names of the points of a matrix at which the failure is unsafe, in the study's order.
    """

    because: BrakingComparison
    points: tuple[str, ...]


def compare_at_points(system: System, original: FloatArray, settings: FloatArray, unsafe: Unsafe) -> tuple[list[PointComparison], float]:
    """Compare settings, shape (M, n), with the original, shape (1, n); also returns the time step of the simulations [s]."""
    at_points = simulate_all_points(system, np.concatenate([original, settings]))
    names, worst = unsafe_points_of(system, at_points, unsafe)[1:], worst_points(at_points)[1:]
    comparisons = []
    for row, (failing_points, worst_index) in enumerate(zip(names, worst.tolist(), strict=True), 1):
        at_point = at_points[worst_index]
        original_run, changed_run = (summarise_run(at_point.runs, column, float(at_point.evaluations.f_safe[column]))
                                     for column in (0, row))
        comparisons.append(PointComparison(compare_braking(original_run, changed_run, at_point.point.name), failing_points))
    return comparisons, at_points[0].runs.trace.step


def compare_at_cells(evaluator: Evaluator, original: FloatArray, settings: FloatArray) -> tuple[list[PointComparison], float]:
    """As `compare_at_points`, for a rated study: finds the cells whose colour is worse than the original's; compares in the worst cell.

    An unknown colour is neither better nor worse.
    """
    system = assemble(evaluator.study)
    assert system.rater is not None
    colours = system.rater.points(evaluator.simulate_cells(np.concatenate([original, settings]), "cells that turn")).colours.astype(int)
    comparisons, step = list[PointComparison](), 0.0
    for row in range(1, len(colours)):
        colour_loss = np.where(colours[0] == UNKNOWN_COLOUR, 0, np.maximum(colours[row] - colours[0], 0))
        point = system.matrix[int(np.argmax(colour_loss))]
        (at_point,) = simulate_all_points(system.at(point), np.concatenate([original, settings[row - 1:row]]))
        original_run, changed_run = (summarise_run(at_point.runs, column, float(at_point.evaluations.f_safe[column])) for column in (0, 1))
        names = tuple(system.matrix[k].name for k in np.flatnonzero(colour_loss).tolist())
        comparisons.append(PointComparison(compare_braking(original_run, changed_run, point.name), names))
        step = at_point.runs.trace.step
    return comparisons, step


def unsafe_points_of(system: System, at_points: list[PointResult], unsafe: Unsafe) -> list[tuple[str, ...]]:
    """Names of the matrix's points at which each setting is unsafe; empty without a matrix."""
    if not system.matrix:
        return [() for _ in at_points[0].evaluations.settings]
    unsafe_at_points = np.stack([unsafe.of(at_point.evaluations) for at_point in at_points])
    return [tuple(at_point.point.name for at_point, is_unsafe in zip(at_points, column, strict=True) if is_unsafe)
            for column in unsafe_at_points.T]


def points_in_words(points: tuple[str, ...], number: int, limit: int = MAX_POINTS_NAMED) -> str:
    """A sentence such as `Fails at 2 of 72 points: CPNA, speed 40, impact_location 25, night; CPLA, speed 60, clear.`"""
    names, rest = "; ".join(points[:limit]), len(points) - limit
    others = f" and {rest} more" if rest > 0 else ""
    return f"Fails at {len(points)} of {number} points{': ' + names if points else ''}{others}."


class FailureSelection(NamedTuple):
    """The failures to explain, of a study or of results, with their minimal causes.

    Attributes
    ----------
    sample
        The rows that were analysed: all failures, or a random sample of them.
    causes
        The minimal causes of the sample and of the chosen failures, by row.
    reasons
        The reasons for the choice of each chosen row.
    """

    original: Evaluations
    failures: Failures
    sample: list[int]
    causes: Causes
    reasons: Mapping[int, Reasons]


def choose_failures(source: Study | Case, options: ExplainOptions, evaluator: Evaluator) -> FailureSelection:
    """Choose the failures that the options name, or the failures that matter; raises what `explain_failures` raises."""
    unsafe = None if options.unsafe is None else evaluator.parse_criterion(options.unsafe)
    named_solutions = [SolutionId.parse(text, "solutions") for text in options.solutions]
    limit = options.limit // len(assemble(evaluator.study).points)
    original = evaluator.evaluate_original()
    failures = find_failures(source, evaluator, original, named_solutions, unsafe)
    settings, rows = failures.evaluations.settings, failures.rows
    sample = rows if named_solutions else [rows[i] for i in select_affordable_rows(settings[rows], evaluator, limit)]
    robust = None if named_solutions or is_rated(evaluator.study) else _find_robust_row(failures, evaluator, original, limit)
    reasons = dict.fromkeys(rows[:len(named_solutions)], ("asked for",)) if named_solutions else _reasons_of_choices(failures, robust)
    analysed_rows = sorted({*sample, *reasons})
    causes = dict(zip(analysed_rows, find_minimal_causes(evaluator, settings[analysed_rows], failures.unsafe), strict=True))
    if not named_solutions:
        reasons = _with_distinct_causes(failures, evaluator, {row: causes[row] for row in sample}, reasons, causes, options.top)
    return FailureSelection(original, failures, sample, causes, reasons)


def explain_failures(source: Study | Case, options: ExplainOptions, *, pool: Pool | None = None, jobs: int | None = None,
                     progress: Progress = show_no_progress) -> Explained:
    """Explain the failures that matter among the solutions of results, or among settings all over a study's domain.

    Raises
    ------
    InputError
        If `unsafe` or a handle cannot be read, or the study cannot be assembled.
    """
    study = source if isinstance(source, Study) else source.study
    with open_evaluator(study, pool, jobs, progress) as evaluator:
        original, failures, sample, causes, reasons = choose_failures(source, options, evaluator)
        settings = failures.evaluations.settings
        explanations = _explain_in_full(failures, evaluator, original, causes, reasons)
        preventable = assess_preventability(evaluator, settings[_avoidable_collisions(study, failures.evaluations)])
    sample_causes, characteristics = [causes[row] for row in sample], evaluator.characteristics
    changed = characteristics.changed(settings[sample])
    return Explained(
        study=study, unsafe=failures.unsafe, original=original, explanations=explanations,
        necessity=necessity_frame(characteristics, changed, sample_causes, len(failures.rows)),
        distinct=count_distinct_causes(characteristics, sample_causes), looked_at=len(failures.evaluations), failures=len(failures.rows),
        analysed=len(sample), otherwise=failures.deviations, preventability=preventable)


def _avoidable_collisions(study: Study, evaluations: Evaluations) -> BoolArray:
    """Which collisions another driver may avoid; none in a rated study, where every vehicle collides in some cell."""
    return np.asarray(evaluations.collided & (not is_rated(study)))


def _find_robust_row(failures: Failures, evaluator: Evaluator, original: Evaluations, limit: int) -> int | None:
    """Row of the smallest robust failure found within the limit; None without such a failure, or if the original vehicle is unsafe."""
    if not failures.rows or failures.unsafe.of(original)[0]:
        return None
    _, step = compare_at_points(assemble(evaluator.study), original.settings, original.settings[:0], failures.unsafe)
    row = find_smallest_robust_failure(evaluator, failures.evaluations.take(failures.rows), step, failures.unsafe, limit)
    return None if row is None else failures.rows[row]


def _reasons_of_choices(failures: Failures, robust: int | None) -> dict[int, Reasons]:
    """Reasons to explain a failure, by its row: smallest robust, fewest changes, most severe, smallest changes."""
    reasons: dict[int, Reasons] = {} if robust is None else {robust: (ROBUST,)}
    for choice in ("fewest", "most_severe", "smallest"):
        if failures.rows:
            row = failures.row_of(choice)
            reasons[row] = (*reasons.get(row, ()), REASONS[choice])
    return reasons


def _with_distinct_causes(failures: Failures, evaluator: Evaluator, sample: Causes, reasons: Mapping[int, Reasons], causes: Causes,
                          top: int) -> dict[int, Reasons]:
    """Add, up to `top` failures in all, the simplest failure of each distinct minimal cause that no chosen failure has yet."""
    chosen = dict(list(reasons.items())[:top])
    keys = {row: {cause_key(evaluator.characteristics, cause) for cause in group} for row, group in causes.items()}
    for key in count_distinct_causes(evaluator.characteristics, list(sample.values()))["cause"]:
        if len(chosen) >= top:
            break
        if not any(key in keys[row] for row in chosen):
            candidates = [row for row in sample if key in keys[row]]
            simplest = min(candidates, key=lambda row: (failures.evaluations.f_num_diff[row], failures.evaluations.f_diff[row], row))
            chosen[simplest] = ("a cause of its own",)
    return chosen


def _explain_in_full(failures: Failures, evaluator: Evaluator, original: Evaluations, causes: Causes,
                     reasons: Mapping[int, Reasons]) -> tuple[Explanation, ...]:
    """Explanations of the chosen failures."""
    if not reasons:
        return ()
    rows = list(reasons)
    chosen, names = failures.evaluations.take(rows), evaluator.characteristics.names
    all_causes = [cause for row in rows for cause in causes[row]]
    if is_rated(evaluator.study):  # each neighbour is simulated in all cells, which takes too long for all causes
        comparisons, step = compare_at_cells(evaluator, original.settings, chosen.settings)
        robustnesses = estimate_robustness(evaluator, chosen.settings, step, failures.unsafe, STEP_FACTORS[:1])
    else:
        comparisons, step = compare_at_points(assemble(evaluator.study), original.settings, chosen.settings, failures.unsafe)
        settings = np.array([*chosen.settings, *(cause.setting for cause in all_causes)])
        robustnesses = estimate_robustness(evaluator, settings, step, failures.unsafe)
    boundaries, neighbours = iter(find_boundaries(evaluator, all_causes, failures.unsafe)), iter(robustnesses[len(rows):])
    collided = np.flatnonzero(_avoidable_collisions(evaluator.study, chosen))
    categories = dict(zip(collided.tolist(), classify_collisions(evaluator, chosen.settings[collided]), strict=True))
    explanations = []
    for i, row in enumerate(rows):
        described_causes = []
        for cause in causes[row]:
            boundary = next(boundaries)
            described_causes.append(Cause(
                changes={names[column]: float(cause.setting[column]) for column in cause.columns},
                boundary={names[column]: float(boundary.setting[column]) for column in cause.columns}, fraction=boundary.fraction,
                alone={names[column]: value for column, value in boundary.single_limits.items()}, outcome=cause.outcome,
                safety_degree=cause.safety_degree, end=boundary.end,
                at_threshold=None if boundary.at_threshold is None else names[boundary.at_threshold], neighbours=next(neighbours, None)))
        changed = evaluator.characteristics.changed(chosen.settings[i])
        explanations.append(Explanation(
            handle=failures.handles[row], reasons=reasons[row], setting=dict(zip(names, chosen.settings[i].tolist(), strict=True)),
            outcome=str(chosen.outcome[i]), safety_degree=finite_or_none(chosen.f_safe[i]),
            changed=tuple(name for name, is_changed in zip(names, changed, strict=True) if is_changed),
            necessary=tuple(names[column] for column in sorted(necessary_columns(causes[row]))), causes=tuple(described_causes),
            robustness=robustnesses[i], because=comparisons[i].because, points=comparisons[i].points,
            preventable=str(categories.get(i) or "")))
    return tuple(explanations)
