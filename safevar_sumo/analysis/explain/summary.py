"""The first lines of a study's summary: a paragraph for a manager, then the failures that matter with their minimal causes."""

from __future__ import annotations

from operator import attrgetter

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.causes import MinimalCause, find_minimal_causes
from safevar_sumo.analysis.explain.compute import compare_at_points, unsafe_points_of
from safevar_sumo.analysis.explain.paragraph import FailureDescription, failures_paragraph
from safevar_sumo.analysis.explain.result import LABELS, REASONS, most_robust
from safevar_sumo.analysis.explain.robustness import Robustness, estimate_robustness, find_smallest_robust_failure
from safevar_sumo.analysis.preventability import assess_preventability
from safevar_sumo.analysis.rating.summary import summarise_rated_solutions
from safevar_sumo.analysis.words import list_of_changes, number_of, points_in_words, question_command
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.records import Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import CHOICES, choose_handle, handles_of, record, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import simulate_all_points, study_at, worst_points
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.evaluation import Pool

MAX_ESTIMATED_CAUSES = 20
"""Number of minimal causes of a failure up to which their robustness is estimated at the end of a study; `explain` estimates all."""


def summarise_failures(study: Study, solutions: pd.DataFrame, original: Evaluations, pool: Pool, directory: str,
                       progress: Progress = show_no_progress) -> list[str]:
    """Summarise a study's solutions in lines: first a paragraph for a manager, last the command for the next step.

    The criterion is `Unsafe.default`.

    Parameters
    ----------
    solutions
        A frame that `safevar_sumo.results.solutions_frame` has made.
    original
        The original vehicle's evaluation.
    pool
        Simulates subsets of the solutions' changes.
    directory
        The directory of the results.
    """
    if RATING_POINTS.name in original.metrics:
        return summarise_rated_solutions(study, solutions, original, directory)
    if original.collided[0]:
        return ["The original vehicle itself collides: no change is needed."]
    evaluator, degree = Evaluator(study, pool, progress), float(original.f_safe[0])
    criterion = Unsafe.default(record(original, 0), solutions["outcome"])
    unsafe = criterion.rows(solutions)
    if not unsafe.any():
        return [f"Nothing unsafe found in {number_of(len(solutions), 'solution')}: no collision, no SD below half of the original's.",
                f"How far each characteristic may go: {question_command('tolerance', directory)}"]
    handle_of = {reason: choose_handle(solutions, criterion, choice, study.name) for choice, reason in REASONS.items()}
    rows = solutions.iloc[[row_of_handle(solutions, handle) for handle in handle_of.values()]]
    settings = rows[list(evaluator.characteristics.names)].to_numpy(dtype=float)
    all_causes = find_minimal_causes(evaluator, settings, criterion)
    failing_points, worst = _find_failing_points(study, settings, criterion)
    number_distinct = len(solutions.drop_duplicates(list(evaluator.characteristics.names)))
    settings_in_words = "" if number_distinct == len(solutions) else f" ({number_distinct} different settings)"
    unsafe_in_words = f"{int(unsafe.sum())} of {number_of(len(solutions), 'solution')}{settings_in_words}"
    lines = [_write_paragraph(evaluator, solutions, unsafe, original, criterion, worst),
             f"{unsafe_in_words} collide." if criterion.below is None else
             f"No collision. {unsafe_in_words} keep less than half of the original's {degree:.2f} m."]
    for (reason, handle), row, causes, fails_at in zip(handle_of.items(), rows.to_dict("records"), all_causes, failing_points, strict=True):
        size = f"{number_of(int(row['f_num_diff']), 'change')} of up to {100 * row['f_diff']:.0f} %"
        ending, cause = f"{row['outcome']}, SD {row['f_safe']:.2f}", _cause_in_words(evaluator, causes)
        lines.append(f"{LABELS.get(reason, reason).capitalize()}: {handle}, {ending}, {size}. {cause}{fails_at}")
    at_worst = f"at the worst point of the first (without --point: at all {len(assemble(study).points)}, which takes long)"
    return [*lines, f"Causes and limits{f', {at_worst}' if worst else ''}: {question_command('explain', directory, worst)}"]


def _write_paragraph(evaluator: Evaluator, solutions: pd.DataFrame, is_unsafe: pd.Series[bool], original: Evaluations, unsafe: Unsafe,
                     point: str) -> str:
    """One paragraph on the unsafe solutions; with `point`, on those that are unsafe at this test point."""
    names, all_handles = evaluator.characteristics.names, handles_of(solutions)
    candidates = np.flatnonzero(is_unsafe.to_numpy() & ~solutions.duplicated(list(names)).to_numpy())
    if point:
        evaluator = evaluator.for_study(study_at(evaluator.study, point, source=point))
        original = evaluator.evaluate_original()
    system = assemble(evaluator.study)
    evaluations = evaluator.evaluate(solutions.iloc[candidates][list(names)].to_numpy(dtype=float), "unsafe solutions")
    preventable = assess_preventability(evaluator, evaluations.take(evaluations.collided))
    failing_rows = np.flatnonzero(unsafe.of(evaluations))
    failures = evaluations.take(failing_rows)
    if not len(failures):
        return failures_paragraph(system, original, None, None, preventable)
    step = compare_at_points(system, original.settings, original.settings[:0], unsafe)[1]
    robust_row = find_smallest_robust_failure(evaluator, failures, step, unsafe, _max_robustness_evaluations(evaluator.study, system))
    fewest_row = int(np.lexsort([getattr(failures, name) for name in reversed(CHOICES["fewest"])])[0])
    rows = [fewest_row] if robust_row is None else [fewest_row, robust_row]
    descriptions, chosen = [], failures.take(rows)
    causes = find_minimal_causes(evaluator, chosen.settings, unsafe)
    for index, (robustness, cause_robustness) in enumerate(_estimate_robustnesses(evaluator, chosen.settings, causes, step, unsafe)):
        changed = np.flatnonzero(evaluator.characteristics.changed(chosen.settings[index]))
        changes = {names[column]: float(chosen.settings[index, column]) for column in changed}
        name, degree = str(all_handles[candidates[failing_rows[rows[index]]]]), finite_or_none(chosen.f_safe[index])
        descriptions.append(FailureDescription(name, changes, str(chosen.outcome[index]), degree, robustness,
                                               len(causes[index][0].columns), cause_robustness))
    return failures_paragraph(system, original, descriptions[0], descriptions[1] if len(descriptions) > 1 else None, preventable)


def _max_robustness_evaluations(study: Study, system: System) -> int:
    """Limit on the search for a robust failure at the end of a study: that of `explain`, but no more than the study's own evaluations."""
    search = study.search
    return min(ExplainOptions.limit // len(system.points), len(search.algorithms) * search.runs * search.evaluations)


def _estimate_robustnesses(evaluator: Evaluator, settings: FloatArray, causes: list[list[MinimalCause]], step: float,
                           unsafe: Unsafe) -> list[tuple[Robustness, Robustness | None]]:
    """The robustness of each failure, and of its most robust cause by itself: None if it has more than `MAX_ESTIMATED_CAUSES`."""
    estimated = [group if len(group) <= MAX_ESTIMATED_CAUSES else [] for group in causes]
    cause_settings = [cause.setting for group in estimated for cause in group]
    estimates = iter(estimate_robustness(evaluator, np.array([*settings, *cause_settings]), step, unsafe))
    failures = [next(estimates) for _ in settings]
    named = [most_robust([next(estimates) for _ in group], share=attrgetter("share")) for group in estimated]
    return list(zip(failures, named, strict=True))


def _find_failing_points(study: Study, settings: FloatArray, unsafe: Unsafe) -> tuple[list[str], str]:
    """A sentence for each setting on the points where it fails, and the first setting's worst point; empty without a test matrix."""
    system = assemble(study)
    if not system.matrix:
        return [""] * len(settings), ""
    results = simulate_all_points(system, settings)
    sentences = [f" {points_in_words(points, len(system.matrix), limit=3)}" for points in unsafe_points_of(system, results, unsafe)]
    return sentences, results[worst_points(results)[0]].point.name


def _cause_in_words(evaluator: Evaluator, causes: list[MinimalCause]) -> str:
    """A sentence on a setting's first minimal cause and on the number of its other minimal causes."""
    if not causes:
        return "Simulated again, it is not unsafe."
    values = {evaluator.characteristics.names[column]: float(causes[0].setting[column]) for column in causes[0].columns}
    rest = len(causes) - 1
    others = f" ({number_of(rest, 'alternative set')} of the same size; see explain)" if rest else ""
    return f"These changes alone cause it: {list_of_changes(evaluator.characteristics, values)}{others}."
