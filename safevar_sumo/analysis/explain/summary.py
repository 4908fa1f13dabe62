"""The first lines of a study's summary: the verdict that `explain` gives, then the failures that matter with their
causes.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.compute import explain_failures, unsafe_points_of
from safevar_sumo.analysis.explain.sentences import (
    choices_in_words,
    counts_in_words,
    situation_in_words,
    verdict_in_words,
)
from safevar_sumo.analysis.rating.summary import summarise_rated_solutions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.subject import at_point
from safevar_sumo.analysis.words import points_in_words, question_command
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.progress import Progress, show_no_progress
from safevar_sumo.records import Evaluations
from safevar_sumo.results import choose_handle, row_of_handle
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble


def summarise_failures(
    case: Case, original: Evaluations, pool: Pool, directory: str, progress: Progress = show_no_progress
) -> list[str]:
    """Summarise results in lines: the verdict first, the command for the next step last; no line without a solution.

    Of a matrix, the failures are those at the worst point of the failure with the fewest changes.

    Parameters
    ----------
    original
        The original vehicle's evaluation.
    pool
        Simulates subsets of the solutions' changes.
    directory
        The directory of the results, for the command.
    """
    study, solutions, names = case.study, case.solutions, list(case.characteristics.names)
    if RATING_POINTS.name in original.metrics:
        return summarise_rated_solutions(study, solutions, original, directory)
    if original.collided[0]:
        return ["The original vehicle itself collides: no change is needed."]
    lines, point, unsafe, system = list[str](), "", case.unsafe, assemble(study)
    if system.matrix:
        distinct = solutions.drop_duplicates(names)
        rows = solutions.iloc[
            [
                row_of_handle(solutions, choose_handle(solutions, unsafe, choice, study.name))
                for choice in ("most_severe", *(["fewest"] if unsafe.rows(solutions).any() else []))
            ]
        ]
        evaluations = Evaluator(study, pool, progress).evaluate(rows[names].to_numpy(float), "worst points")
        lines = [
            situation_in_words(system, original, evaluations.take([0]), len(distinct)),
            (
                f"{int(unsafe.rows(distinct).sum())} of {len(distinct)} different vehicles are unsafe: "
                f"{unsafe.description}."
            ),
        ]
        if len(rows) > 1 and evaluations.worst_points is not None:
            point = system.points[evaluations.worst_points[1]].name
            case = at_point(case, point)
    if point or not system.matrix:
        explained = explain_failures(case, ExplainOptions(), pool=pool, progress=progress, statistics=False)
        failures = choices_in_words(explained)
        if point:
            settings = np.array([list(failure.setting.values()) for failure in explained.explanations])
            fails_at = unsafe_points_of(system, simulate_all_points(system, settings), unsafe) if len(settings) else []
            failures = [
                f"{line} {points_in_words(points, len(system.matrix), limit=3)}"
                for line, points in zip(failures, fails_at, strict=True)
            ]
        lines += [
            " ".join(verdict_in_words(explained)),
            f"{'There, ' if point else ''}{counts_in_words(explained)}",
            *failures,
        ]
    if not unsafe.rows(solutions).any():
        return [*lines, f"How far each characteristic may go: {question_command('tolerance', directory)}"]
    at_worst = f", at the worst point of the first (without --point: at all {len(system.points)}, which takes long)"
    return [*lines, f"Causes and limits{at_worst if point else ''}: {question_command('explain', directory, point)}"]
