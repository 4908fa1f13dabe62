"""Explains failures: the changes that cause them, how small a change is enough, the reason in words, and the
robustness.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.rater import UNKNOWN as UNKNOWN_COLOUR, is_rated
from safevar_sumo.questions.case import Case, are_collisions
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import ExplainOptions
from safevar_sumo.questions.explain.across_fits import count_holding, measure_across_fits
from safevar_sumo.questions.explain.answer import DRAWN, SOLUTIONS, Explained
from safevar_sumo.questions.explain.causes import (
    STEP_FACTORS,
    Cause,
    Robustness,
    cause_key,
    count_distinct_causes,
    describe_causes,
    estimate_robustness,
    find_minimal_causes,
    find_smallest_robust_failure,
    necessity_frame,
    select_affordable_rows,
)
from safevar_sumo.questions.explain.failure import DISTINCT_CAUSE, REASONS, ROBUST, Explanation
from safevar_sumo.questions.preventability import assess_preventability, avoided_by, judge_collisions
from safevar_sumo.questions.words import ending_in_words
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, handles_of, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import contact_degree, evaluate, simulate, simulate_all_points, worst_points
from safevar_sumo.sumo.system import System, assemble

Reasons = dict[int, tuple[str, ...]]
"""The rows of the chosen failures, with the reasons for their choice."""
SAMPLED_SETTINGS, RATED_SAMPLED_SETTINGS = 4096, 64
"""Number of settings drawn from the whole domain if there are no results, in an unrated and in a rated study."""


def explain_failures(source: Study | Case, options: ExplainOptions, evaluator: Evaluator) -> Explained:
    """Explain the failures that matter among the solutions of results, or among settings drawn from a study's whole
    domain.

    Raises
    ------
    InputError
        If `unsafe` or a handle cannot be read, or a handle is no solution of the results.
    """
    study, characteristics = evaluator.study, evaluator.characteristics
    population = _evaluate(source, options, evaluator)
    limit = options.limit // len(assemble(study).points)  # an evaluation simulates a setting at every point
    settings, sample = population.evaluations.settings, population.rows
    reasons: Reasons = dict.fromkeys(population.rows, ("requested",))
    if not options.solutions:
        reasons = _choose_rows(population, limit)
        affordable = select_affordable_rows(settings[population.rows], evaluator, limit)
        sample = [population.rows[index] for index in affordable]
    analysed = sorted({*sample, *reasons})
    causes = dict(zip(analysed, find_minimal_causes(evaluator, settings[analysed], population.unsafe), strict=True))
    sample_causes = [causes[row] for row in sample]
    distinct = count_distinct_causes(characteristics, sample_causes)
    if not options.solutions:
        reasons = _add_distinct_causes(population, sample, reasons, causes, distinct["cause"], options.top)
    left_out = 0  # collisions that the search simulated, but its objectives leave out of the solutions
    if isinstance(source, Case) and not study.origin.point and not population.evaluations.collided.any():
        left_out = int(are_collisions(source.evaluations).sum())
    models = evaluator.for_sets(options.fits if len(population.evaluations) else 0)
    preventability = assess_preventability(
        evaluator, population.evaluations.take(_is_assessed(study, population.evaluations))
    )
    necessity = necessity_frame(
        characteristics, characteristics.changed(settings[sample]), sample_causes, len(population.rows)
    )
    return Explained(
        study=study,
        unsafe=population.unsafe,
        original=population.original,
        nearest=population.evaluations.take(np.argsort(population.evaluations.f_safe, kind="stable")[:1]),
        explanations=_explain_rows(population, causes, reasons, models),
        necessity=necessity,
        distinct=distinct,
        looked_at=len(population.evaluations),
        failures=len(population.rows),
        analysed=len(sample),
        kind=DRAWN if isinstance(source, Study) else SOLUTIONS,
        otherwise=population.otherwise,
        left_out=left_out,
        preventability=preventability,
        no_verdict=evaluator.no_verdict,
        across_fits=measure_across_fits(models, population.evaluations, population.unsafe, necessity, preventability)
        if models
        else None,
    )


class Population(NamedTuple):
    """Evaluated settings, safe ones too, and the failures among them.

    Attributes
    ----------
    evaluations
        Equal solutions of several runs are one row.
    handles
        The handle of each row; None if the setting is no solution.
    rows
        The unsafe rows, or those that the options name.
    otherwise
        Number of rows with another outcome than in the results.
    """

    evaluator: Evaluator
    original: Evaluations
    evaluations: Evaluations
    handles: Sequence[SolutionId | None]
    unsafe: Unsafe
    rows: list[int]
    otherwise: int


def _evaluate(source: Study | Case, options: ExplainOptions, evaluator: Evaluator) -> Population:
    """Evaluate all solutions of results, or settings drawn from a study's whole domain."""
    unsafe = None if options.unsafe is None else evaluator.parse_criterion(options.unsafe)
    named = [SolutionId.parse(text, "solutions") for text in options.solutions]
    original = evaluator.evaluate_original()
    handles: Sequence[SolutionId | None]
    if isinstance(source, Study):
        if named:
            raise InputError("solutions", f"{source.name!r} is a study and has no solutions", "a results directory")
        number = RATED_SAMPLED_SETTINGS if is_rated(source) else SAMPLED_SETTINGS
        drawn = evaluator.feasible_settings(number, source.search.seed, feasible_after_filter=True)
        settings = evaluator.characteristics.filter(drawn)
        handles, recorded = [None] * len(settings), np.full(len(settings), UNKNOWN)
    else:
        solutions, names = source.solutions, list(evaluator.characteristics.names)
        named_rows = [row_of_handle(solutions, handle, "solutions") for handle in named]
        distinct = np.flatnonzero(~solutions.duplicated(names)).tolist()
        chosen = list(dict.fromkeys([*named_rows, *distinct]))  # the named ones first
        settings, all_handles = solutions[names].to_numpy(dtype=float)[chosen], handles_of(solutions)
        handles, recorded = [all_handles[row] for row in chosen], solutions["outcome"].to_numpy(dtype=str)[chosen]
    evaluations = evaluator.evaluate(settings, "settings to explain")
    criterion = unsafe or Unsafe.default_among(evaluations, original)
    rows = np.flatnonzero(criterion.of(evaluations)).tolist()
    if named:
        rows = list(range(len(set(named))))  # they come first
    otherwise = np.count_nonzero((evaluations.outcome != recorded) & (recorded != UNKNOWN))
    return Population(evaluator, original, evaluations, handles, criterion, rows, int(otherwise))


def _is_assessed(study: Study, evaluations: Evaluations) -> BoolArray:
    """Which vehicles collide, so that their preventability is assessed; none in a rated study, where every vehicle
    collides in some cell.
    """
    return evaluations.collided & (not is_rated(study))


def _choose_rows(population: Population, limit: int) -> Reasons:
    """Choose the smallest robust failure, and a failure for each of `REASONS`."""
    reasons, failures, evaluator = Reasons(), population.evaluations.take(population.rows), population.evaluator
    if not population.rows:
        return reasons
    if not is_rated(evaluator.study) and not population.unsafe.of(population.original)[0]:
        index = find_smallest_robust_failure(evaluator, failures, _time_step(evaluator.study), population.unsafe, limit)
        if index is not None:
            reasons[population.rows[index]] = (ROBUST,)
    for choice, reason in REASONS.items():
        order = np.lexsort([failures.column(name) for name in reversed(CHOICES[choice])])
        row = population.rows[order[0]]
        reasons[row] = (*reasons.get(row, ()), reason)
    return reasons


def _add_distinct_causes(
    population: Population,
    sample: Sequence[int],
    reasons: Reasons,
    causes: dict[int, list[Cause]],
    distinct: Iterable[tuple[str, ...]],
    top: int,
) -> Reasons:
    """Add the simplest failure in `sample` of every `distinct` minimal cause that no chosen failure has, until `top`
    failures are chosen.
    """
    reasons, evaluations = dict(list(reasons.items())[:top]), population.evaluations
    keys = {row: {cause_key(population.evaluator.characteristics, cause) for cause in causes[row]} for row in causes}
    for key in distinct:
        if len(reasons) < top and not any(key in keys[row] for row in reasons):
            rows = [row for row in sample if key in keys[row]]
            simplest = min(rows, key=lambda row: (evaluations.f_num_diff[row], evaluations.f_diff[row], row))
            reasons[simplest] = (DISTINCT_CAUSE,)
    return reasons


def _explain_rows(
    population: Population, causes: dict[int, list[Cause]], reasons: Reasons, models: Sequence[Evaluator]
) -> tuple[Explanation, ...]:
    """Explanations of the chosen failures; `models` are the fitted vehicle models in which a cause may hold."""
    if not reasons:
        return ()
    evaluator, unsafe, failures = population.evaluator, population.unsafe, population.evaluations.take(list(reasons))
    characteristics, study, settings = evaluator.characteristics, evaluator.study, failures.settings
    described = describe_causes(evaluator, [cause for row in reasons for cause in causes[row]], unsafe)
    robustness_of_causes: Sequence[Robustness | None] = [None] * len(described)
    if is_rated(study):  # each neighbour is simulated in all cells, which takes too long for all causes
        comparisons = compare_at_cells(evaluator, population.original.settings, settings)
        robustnesses = estimate_robustness(evaluator, settings, _time_step(study), unsafe, STEP_FACTORS[:1])
    else:
        comparisons = compare_at_points(assemble(study), population.original.settings, settings, unsafe)
        cause_settings = (cause.setting(characteristics) for cause in described)
        robustnesses = estimate_robustness(evaluator, np.array([*settings, *cause_settings]), _time_step(study), unsafe)
        robustness_of_causes = robustnesses[len(settings) :]
    holding = count_holding(models, described, unsafe)
    remaining_causes = (  # taken below, failure by failure
        replace(cause, neighbours=robustness, sets=len(models), holds=holds)
        for cause, robustness, holds in zip(described, robustness_of_causes, holding, strict=True)
    )
    is_assessed, contact = _is_assessed(study, failures), contact_degree(assemble(study))
    verdicts = iter(judge_collisions(evaluator, failures.take(is_assessed)).to_dict("records"))
    explanations = []
    for index, (row, (endings, points)) in enumerate(zip(reasons, comparisons, strict=True)):
        explanations.append(
            Explanation(
                characteristics=characteristics,
                handle=population.handles[row],
                reasons=reasons[row],
                setting=dict(zip(characteristics.names, settings[index].tolist(), strict=True)),
                outcome=str(failures.outcome[index]),
                safety_degree=finite_or_none(failures.f_safe[index]),
                contact=contact,
                causes=tuple(islice(remaining_causes, len(causes[row]))),
                robustness=robustnesses[index],
                endings=endings,
                points=points,
                preventable=avoided_by(next(verdicts)) if is_assessed[index] else "",
            )
        )
    return tuple(explanations)


def _time_step(study: Study) -> float:
    """The time step of the simulations [s]."""
    system = assemble(study)
    return simulate(system.at(system.points[0]), system.characteristics.original[np.newaxis]).trace.step


PointComparison = tuple[str, tuple[str, ...]]
"""How the runs of the original vehicle and of a failure end at the failure's worst point, in a sentence; and the names
of the points of a test matrix at which it is unsafe (in a rated study, of the cells whose colour is worse than the
original's), in the study's order.
"""


def _endings_in_words(system: System, point: str, evaluations: Evaluations, row: int) -> str:
    """How the runs of the original vehicle, in row 0, and of another vehicle end at a point."""
    contact = contact_degree(system)
    original, changed = (
        ending_in_words(str(evaluations.outcome[k]), float(evaluations.f_safe[k]), contact) for k in (0, row)
    )
    return f"{f'At {point}: the' if point else 'The'} original {original}; this one {changed}."


def compare_at_points(
    system: System, original: FloatArray, settings: FloatArray, unsafe: Unsafe
) -> list[PointComparison]:
    """Compare settings, shape (M, n), with the original, shape (1, n)."""
    results = simulate_all_points(system, np.concatenate([original, settings]))
    at_points = [result.evaluations for result in results]
    is_unsafe, worst = np.stack([unsafe.of(evaluations) for evaluations in at_points]), worst_points(system, at_points)
    comparisons = []
    for vehicle in range(1, len(worst)):  # vehicle 0 is the original
        names = (result.point.name for result, fails in zip(results, is_unsafe[:, vehicle], strict=True) if fails)
        at_worst = results[worst[vehicle]]
        sentence = _endings_in_words(system, at_worst.point.name, at_worst.evaluations, vehicle)
        comparisons.append((sentence, tuple(filter(None, names))))  # without a matrix, the only point has no name
    return comparisons


def compare_at_cells(evaluator: Evaluator, original: FloatArray, settings: FloatArray) -> list[PointComparison]:
    """Compare settings with the original as `compare_at_points` does, for a rated study: at the cell whose colour
    worsens most.

    An unknown colour is neither better nor worse.
    """
    system = assemble(evaluator.study)
    assert system.rater is not None
    cells = evaluator.simulate_cells(np.concatenate([original, settings]), "cells whose colour is worse")
    colours = system.rater.points(cells).colours.astype(int)
    # Steps by which a colour is worse; the original is in row 0.
    losses = np.where(colours[0] == UNKNOWN_COLOUR, 0, np.maximum(colours[1:] - colours[0], 0))
    comparisons = []
    for setting, loss in zip(settings, losses, strict=True):
        point = system.matrix[int(np.argmax(loss))]
        evaluations = evaluate(system.at(point), np.stack([original[0], setting]))
        worse_cells = tuple(system.matrix[index].name for index in np.flatnonzero(loss).tolist())
        comparisons.append((_endings_in_words(system, point.name, evaluations, 1), worse_cells))
    return comparisons
