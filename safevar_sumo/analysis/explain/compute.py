"""Explains failures: the changes that cause them, how small a change is enough, the reason in words, and the
robustness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.explain.across_fits import count_holding, measure_across_fits
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare_braking, summarise_run
from safevar_sumo.analysis.explain.causes import (
    MinimalCause,
    cause_key,
    count_distinct_causes,
    describe_causes,
    find_minimal_causes,
    necessity_frame,
    select_affordable_rows,
)
from safevar_sumo.analysis.explain.result import Explained, Explanation
from safevar_sumo.analysis.explain.robustness import STEP_FACTORS, estimate_robustness, find_smallest_robust_failure
from safevar_sumo.analysis.explain.sentences import (
    DISTINCT_CAUSE,
    REASONS,
    ROBUST,
    choices_in_words,
    counts_in_words,
    situation_in_words,
    verdict_in_words,
)
from safevar_sumo.analysis.preventability import assess_preventability, classify_collisions
from safevar_sumo.analysis.rating.render import summarise_rated_solutions
from safevar_sumo.analysis.research_questions.case import Case
from safevar_sumo.analysis.subject import at_point
from safevar_sumo.analysis.words import question_command
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import UNKNOWN as UNKNOWN_COLOUR, is_rated
from safevar_sumo.records import Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, choose_handle, handles_of, row_of_handle
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
    source: Study | Case, options: ExplainOptions, evaluator: Evaluator, *, statistics: bool = True
) -> Explained:
    """Explain the failures that matter among the solutions of results, or among settings drawn from a study's whole
    domain.

    Without `statistics`, only the failures that matter by their size or severity, and nothing of all the others.

    Raises
    ------
    InputError
        If `unsafe` or a handle cannot be read, or a handle is no solution of the results.
    """
    study, characteristics = evaluator.study, evaluator.characteristics
    unsafe = None if options.unsafe is None else evaluator.parse_criterion(options.unsafe)
    original = evaluator.evaluate_original()
    found = _evaluate(source, options, evaluator, original, unsafe)
    limit = options.limit // len(assemble(study).points)  # an evaluation simulates a setting at every point
    settings, sample, reasons = found.evaluations.settings, list[int](), Reasons()
    if options.solutions:
        sample, reasons = found.rows, {row: ("requested",) for row in found.rows}
    else:
        if statistics:
            affordable = select_affordable_rows(settings[found.rows], evaluator, limit)
            sample = [found.rows[index] for index in affordable]
        reasons = _choose_rows(found, evaluator, original, limit)
    analysed = sorted({*sample, *reasons})
    causes = dict(zip(analysed, find_minimal_causes(evaluator, settings[analysed], found.unsafe), strict=True))
    if not options.solutions:
        reasons = _add_distinct_causes(found, evaluator, sample, reasons, causes, options.top)
    sample_causes = [causes[row] for row in sample]
    models = evaluator.for_sets(options.fits if statistics else 0)
    preventability = assess_preventability(evaluator, _collisions(study, found.evaluations))
    changed = characteristics.changed(settings[sample])
    necessity = necessity_frame(characteristics, changed, sample_causes, len(found.rows))
    necessary = dict(zip(necessity["characteristic"], necessity["necessary"], strict=True))
    return Explained(
        study=study,
        unsafe=found.unsafe,
        original=original,
        nearest=found.evaluations.take(np.argsort(found.evaluations.f_safe, kind="stable")[:1]),
        explanations=_explain_rows(found, evaluator, original, causes, reasons, models),
        necessity=necessity,
        distinct=count_distinct_causes(characteristics, sample_causes),
        looked_at=len(found.evaluations),
        failures=len(found.rows),
        analysed=len(sample),
        otherwise=found.deviations,
        preventability=preventability,
        no_verdict=evaluator.no_verdict,
        across_fits=measure_across_fits(models, found.evaluations, found.unsafe, necessary, preventability)
        if models
        else None,
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
    reasons, candidates = Reasons(), found.evaluations.take(found.rows)
    if not found.rows:
        return reasons
    if not is_rated(evaluator.study) and not found.unsafe.of(original)[0]:
        step = _time_step(assemble(evaluator.study))
        index = find_smallest_robust_failure(evaluator, candidates, step, found.unsafe, limit)
        if index is not None:
            reasons[found.rows[index]] = (ROBUST,)
    for choice in ("fewest", "most_severe", "smallest"):
        row = found.rows[np.lexsort([candidates.column(name) for name in reversed(CHOICES[choice])])[0]]
        reasons[row] = (*reasons.get(row, ()), REASONS[choice])
    return reasons


def _add_distinct_causes(
    found: _Found, evaluator: Evaluator, sample: Sequence[int], reasons: Reasons, causes: CausesByRow, top: int
) -> Reasons:
    """Add the simplest failure of every minimal cause that no chosen failure has, until `top` failures are chosen."""
    chosen, evaluations = dict(list(reasons.items())[:top]), found.evaluations
    keys = {row: {cause_key(evaluator.characteristics, one) for one in causes[row]} for row in causes}
    for key in count_distinct_causes(evaluator.characteristics, [causes[row] for row in sample])["cause"]:
        if len(chosen) < top and not any(key in keys[row] for row in chosen):
            rows = [row for row in sample if key in keys[row]]
            simplest = min(rows, key=lambda row: (evaluations.f_num_diff[row], evaluations.f_diff[row], row))
            chosen[simplest] = (DISTINCT_CAUSE,)
    return chosen


def _explain_rows(
    found: _Found,
    evaluator: Evaluator,
    original: Evaluations,
    causes: CausesByRow,
    reasons: Reasons,
    models: Sequence[Evaluator],
) -> tuple[Explanation, ...]:
    """Explanations of the chosen failures; `models` are the fitted vehicle models in which a cause may hold."""
    rows, unsafe, system, rated = list(reasons), found.unsafe, assemble(evaluator.study), is_rated(evaluator.study)
    if not rows:
        return ()
    chosen, characteristics = found.evaluations.take(rows), evaluator.characteristics
    all_causes = [cause for row in rows for cause in causes[row]]
    if rated:  # each neighbour is simulated in all cells, which takes too long for all causes
        comparisons = compare_at_cells(evaluator, original.settings, chosen.settings)
        robustnesses = estimate_robustness(evaluator, chosen.settings, _time_step(system), unsafe, STEP_FACTORS[:1])
    else:
        comparisons = compare_at_points(system, original.settings, chosen.settings, unsafe)
        settings = np.array([*chosen.settings, *(cause.setting for cause in all_causes)])
        robustnesses = estimate_robustness(evaluator, settings, _time_step(system), unsafe)
    of_causes = [None] * len(all_causes) if rated else robustnesses[len(rows) :]
    holds = count_holding(models, all_causes, unsafe)
    described = iter(
        replace(cause, sets=len(models), holds=number)
        for cause, number in zip(describe_causes(evaluator, all_causes, unsafe, of_causes), holds, strict=True)
    )
    collisions = _collisions(evaluator.study, chosen)
    avoidances = dict(zip(map(bytes, collisions.settings), classify_collisions(evaluator, collisions), strict=True))
    explanations = []
    for index, (row, (comparison, points)) in enumerate(zip(rows, comparisons, strict=True)):
        setting = dict(zip(characteristics.names, chosen.settings[index].tolist(), strict=True))
        avoidance = avoidances.get(bytes(chosen.settings[index]))
        explanations.append(
            Explanation(
                handle=found.handles[row],
                reasons=reasons[row],
                setting=setting,
                outcome=str(chosen.outcome[index]),
                safety_degree=finite_or_none(chosen.f_safe[index]),
                changed=tuple(item.name for item in characteristics if setting[item.name] != item.original),
                causes=tuple(next(described) for _ in causes[row]),
                robustness=robustnesses[index],
                because=comparison,
                points=points,
                preventable=str(avoidance[0]) if avoidance else "",
            )
        )
    return tuple(explanations)


def _time_step(system: System) -> float:
    """The time step of the simulations [s]."""
    here = system.at(system.points[0]) if system.matrix else system
    return simulate(here, system.characteristics.original[np.newaxis]).trace.step


PointComparison = tuple[BrakingComparison, tuple[str, ...]]
"""One failure at the test points of a study: the comparison with the original vehicle at the failure's worst point, and
the names of the points of a test matrix at which it is unsafe; in a rated study, of the cells whose colour is worse
than the original's. In the study's order.
"""


def compare_at_points(
    system: System, original: FloatArray, settings: FloatArray, unsafe: Unsafe
) -> list[PointComparison]:
    """Compare settings, shape (M, n), with the original, shape (1, n)."""
    results = simulate_all_points(system, np.concatenate([original, settings]))
    is_unsafe = np.stack([unsafe.of(result.evaluations) for result in results])
    return [
        (
            _compare_runs(results[index], row, results[index].point.name),
            tuple(point.name for point, fails in zip(system.matrix, is_unsafe[:, row], strict=False) if fails),
        )
        for row, index in enumerate(worst_points(results)[1:].tolist(), 1)
    ]


def compare_at_cells(evaluator: Evaluator, original: FloatArray, settings: FloatArray) -> list[PointComparison]:
    """As `compare_at_points`, for a rated study: finds the cells whose colour is worse; compares in the worst cell.

    An unknown colour is neither better nor worse.
    """
    system = assemble(evaluator.study)
    assert system.rater is not None
    cells = evaluator.simulate_cells(np.concatenate([original, settings]), "cells whose colour is worse")
    colours = system.rater.points(cells).colours.astype(int)
    losses = np.where(colours[0] == UNKNOWN_COLOUR, 0, np.maximum(colours[1:] - colours[0], 0))
    comparisons = []
    for setting, loss in zip(settings, losses, strict=True):
        point = system.matrix[int(np.argmax(loss))]
        (worst,) = simulate_all_points(system.at(point), np.concatenate([original, setting[np.newaxis]]))
        worse_cells = tuple(system.matrix[index].name for index in np.flatnonzero(loss).tolist())
        comparisons.append((_compare_runs(worst, 1, point.name), worse_cells))
    return comparisons


def _compare_runs(result: PointResult, row: int, point: str) -> BrakingComparison:
    """Compare the original vehicle, setting 0 of a result, with the setting in `row`, at the test point `point`."""
    original_run, changed_run = (summarise_run(result.runs, k, float(result.evaluations.f_safe[k])) for k in (0, row))
    return compare_braking(original_run, changed_run, point)


def summarise_failures(case: Case, original: Evaluations, evaluator: Evaluator, directory: str) -> list[str]:
    """Summarise results in lines: the verdict first, the command for the next step last; no line without a solution.

    Of a matrix, the failures are those at the worst point of the failure with the fewest changes.

    Parameters
    ----------
    original
        The original vehicle's evaluation.
    evaluator
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
    any_unsafe = bool(unsafe.rows(solutions).any())
    if system.matrix:
        distinct = solutions.drop_duplicates(names)
        choices = ("most_severe", *(["fewest"] if any_unsafe else []))
        handles = [choose_handle(solutions, unsafe, choice, study.name) for choice in choices]
        rows = solutions.iloc[[row_of_handle(solutions, handle) for handle in handles]]
        evaluations = evaluator.evaluate(rows[names].to_numpy(float), "worst points")
        count = int(unsafe.rows(distinct).sum())
        lines = [
            situation_in_words(system, original, evaluations.take([0]), len(distinct)),
            f"{count} of {len(distinct)} different vehicles are unsafe: {unsafe.description}.",
        ]
        if any_unsafe and evaluations.worst_points is not None:
            point = system.points[evaluations.worst_points[1]].name
            case = at_point(case, point)
    if point or not system.matrix:
        explained = explain_failures(case, ExplainOptions(), evaluator.for_study(case.study), statistics=False)
        verdict, counts = " ".join(verdict_in_words(explained)), counts_in_words(explained)
        lines += [verdict, f"{'There, ' if point else ''}{counts}", *choices_in_words(explained)]
    if not any_unsafe:
        return [*lines, f"How far each characteristic may go: {question_command('tolerance', directory)}"]
    at_worst = f", at the worst point of the first (without --point: at all {len(system.points)}, which takes long)"
    return [*lines, f"Causes and limits{at_worst if point else ''}: {question_command('explain', directory, point)}"]
