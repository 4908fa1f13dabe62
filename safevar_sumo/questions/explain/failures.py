"""Which failures are explained: those that matter among the solutions of results, or among settings
drawn from a study's whole domain; and how each of them ends beside the original vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress, islice
from typing import NamedTuple

import numpy as np
from numpy.random import default_rng

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.case import Case, Subject
from safevar_sumo.questions.causes import (
    Cause,
    count_distinct_causes,
    find_minimal_causes,
    kinds_of,
    largest_complete,
    select_affordable_rows,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import words
from safevar_sumo.questions.over_sets import VEHICLES, SharesOverSets
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.questions.words import ending_in_words
from safevar_sumo.records import Evaluations, FloatArray, TextArray
from safevar_sumo.results import CHOICES, UNKNOWN, SolutionId, handles_of, row_of_handle
from safevar_sumo.study import Study
from safevar_sumo.sumo.encounters import worst_points
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System

Reasons = dict[int, str]
"""The rows of the chosen failures, with the reasons for their choice."""
TO_EXPLAIN = "simulate the vehicles"
"""A stage of progress."""
REASONS = {
    "fewest": "fewest changes",
    "most_severe": "lowest safety degree",
    "smallest": "smallest changes",
}
"""Reasons for choosing a failure, by the name of the choice in `CHOICES`."""
REQUESTED = "requested"
"""The reason for explaining a solution that the user names."""
DISTINCT_CAUSE = "simplest failure with another cause"
"""The reason for choosing the simplest failure with a cause that no other chosen failure has."""
SAMPLED_SETTINGS = 4096
"""Number of settings drawn from the whole domain if there are no results."""
SAMPLED_SIMULATIONS, LEAST_SAMPLED_SETTINGS = 40_000, 1024
"""Number of simulations up to which they are as many, at all points of a matrix, and the least
number.
"""


class Population(NamedTuple):
    """Evaluated settings, safe ones too, and the failures among them.

    Attributes
    ----------
    original
        Evaluation of the original vehicle.
    evaluations
        Equal solutions of several runs are one row.
    names
        The handle of each row; `drawn:N` if the setting is no solution.
    unsafe
        The criterion.
    rows, is_named
        The unsafe rows, or those that the user names.
    otherwise
        Number of rows with another outcome than in the results.
    omissions
        Number of drawn settings in whose encounter the original vehicle does not keep its margin,
        which are no rows.
    over_sets
        The unsafe shares of drawn settings over the parameter sets; None for solutions.
    """

    original: Evaluations
    evaluations: Evaluations
    names: Sequence[str]
    unsafe: Unsafe
    rows: list[int]
    is_named: bool
    otherwise: int
    omissions: int
    over_sets: SharesOverSets | None


def gather_failures(
    subject: Subject,
    evaluator: Evaluator,
    solutions: Sequence[str],
    criterion: Unsafe | None,
    fits: int,
) -> Population:
    """Evaluate all solutions of results, or settings that vary as a study says, of which the
    first ones, without the filter, are also simulated with the first `fits` parameter sets.

    Raises
    ------
    InputError
        If the criterion or a handle cannot be read, or a handle is no solution of the results.
    """
    # Settings of the study's domain, or solutions of the results.
    named = list(map(SolutionId.parse, solutions))
    original = evaluator.evaluate_original()
    if isinstance(subject, Study):
        if named:
            raise InputError(
                "solution",
                f"{subject.name!r} is a study and has no solutions",
                "a results directory",
            )
        settings, names, recorded = _drawn_from(subject, evaluator)
    else:
        settings, names, recorded = _solutions_of(subject, named)

    # All are simulated here, and judged by one criterion.
    evaluations = evaluator.evaluate(settings, TO_EXPLAIN)
    unsafe = (
        evaluator.checked(criterion)
        if criterion
        else Unsafe.default_among(evaluations, original)
    )
    is_other = (evaluations.outcome != recorded) & (recorded != UNKNOWN)

    # Settings without a valid encounter do not count.
    omissions = 0
    over_sets = None
    if isinstance(subject, Study):
        omissions = int(evaluations.infeasible.sum())
        counts = np.flatnonzero(~evaluations.infeasible)
        evaluations = evaluations.take(counts)
        names = [names[row] for row in counts]
        vehicles = VariationModel(subject).draw(
            VEHICLES, default_rng(subject.search.seed)
        )
        over_sets = SharesOverSets.of(evaluator, unsafe, vehicles, fits=fits)

    # Named settings are explained whatever they do.
    rows = (
        list(range(len(set(named))))
        if named
        else np.flatnonzero(unsafe.of(evaluations)).tolist()
    )
    counted = bool(named), int(is_other.sum()), omissions, over_sets
    return Population(original, evaluations, names, unsafe, rows, *counted)


Candidates = tuple[FloatArray, list[str], TextArray]
"""Settings, shape (M, n), that may be unsafe, their names, and the outcomes in the results, shape
(M,).
"""


def _drawn_from(study: Study, evaluator: Evaluator) -> Candidates:
    """Settings that vary as a study says, after the filter."""
    affordable = SAMPLED_SIMULATIONS // len(evaluator.system.points)
    number = min(SAMPLED_SETTINGS, max(affordable, LEAST_SAMPLED_SETTINGS))
    # Of few simulations most are for the causes of what fails here.
    number = evaluator.at_most(number, 8)
    sampled_settings = VariationModel(study).draw(
        number, default_rng(study.search.seed), filtered=True
    )
    settings = evaluator.characteristics.filter(sampled_settings)
    names = [f"drawn:{row}" for row in range(len(settings))]
    return settings, names, np.full(len(settings), UNKNOWN)


def _solutions_of(case: Case, named: Sequence[SolutionId]) -> Candidates:
    """The distinct solutions of results, the named ones first."""
    table = case.solutions
    characteristics = list(case.characteristics.names)
    distinct = np.flatnonzero(~table.duplicated(characteristics)).tolist()
    chosen = list(
        dict.fromkeys([*(row_of_handle(table, handle) for handle in named), *distinct])
    )
    handles = handles_of(table)
    return (
        table[characteristics].to_numpy(dtype=float)[chosen],
        [str(handles[row]) for row in chosen],
        table["outcome"].to_numpy(dtype=str)[chosen],
    )


class Chosen(NamedTuple):
    """Why failures are chosen, by row; the rows of a sample of all failures; the minimal causes of
    both, by row; and the number of changes up to which these are all, None without a bound.
    """

    reasons: Reasons
    sample: list[int]
    causes: dict[int, list[Cause]]
    complete: int | None


def choose_failures(
    population: Population, evaluator: Evaluator, limit: int, top: int
) -> Chosen:
    """At most `top` failures that matter, and a sample of all failures; of named rows these alone.

    The sample are all failures, if that takes at most about `limit` simulations. What matters: a
    failure for each of `REASONS`, and the simplest failure with each minimal cause that these do
    not have.
    """
    # An evaluation simulates a setting at every point.
    limit //= len(evaluator.system.points)
    runs = population.evaluations
    rows = population.rows
    if population.is_named:
        sample = rows
        reasons = dict.fromkeys(rows, REQUESTED)
    else:
        places = select_affordable_rows(runs.settings[rows], evaluator, limit)
        sample = [rows[place] for place in places]
        reasons = dict(islice(_failures_that_matter(population).items(), top))
        limit *= 2

    # Causes of the sample, and of failures that matter.
    analysed = sorted({*sample, *reasons})
    settings = runs.settings[analysed]
    groups = find_minimal_causes(evaluator, settings, population.unsafe, limit)
    causes = dict(zip(analysed, groups, strict=True))
    numbers = runs.f_num_diff[analysed].astype(int).tolist()
    complete = largest_complete(numbers, limit)
    is_cut = complete < max(numbers, default=0)
    chosen = Chosen(reasons, sample, causes, complete if is_cut else None)
    if population.is_named:
        return chosen

    # For each distinct cause that is missing, the simplest failure that has it.
    members = evaluator.characteristics
    kinds = {row: kinds_of(members, group) for row, group in causes.items()}
    of_sample = [causes[row] for row in sample]
    for kind in count_distinct_causes(members, of_sample)["cause"]:
        if len(reasons) < top and not any(kind in kinds[row] for row in reasons):
            simplest = min(
                (row for row in sample if kind in kinds[row]),
                key=lambda row: (runs.f_num_diff[row], runs.f_diff[row], row),
            )
            reasons[simplest] = DISTINCT_CAUSE
    return chosen


def _failures_that_matter(population: Population) -> Reasons:
    """A failure for each of `REASONS`."""
    reasons = Reasons()
    failures = population.evaluations.take(population.rows)
    for choice, reason in REASONS.items() if population.rows else ():
        columns = map(failures.column, reversed(CHOICES[choice]))
        order = np.lexsort([*columns])
        row = population.rows[order[0]]
        reasons[row] = f"{reasons[row]}; {reason}" if row in reasons else reason
    return reasons


PointComparison = tuple[str, tuple[str, ...]]
"""How the runs of the original vehicle and of a failure end at the failure's worst point, in a
sentence; and the names of the points of a test matrix at which it is unsafe, in the study's order.
"""


def compare_at_points(
    system: System, settings: FloatArray, unsafe: Unsafe
) -> list[PointComparison]:
    """Compare M settings, shape (M, n), with the original vehicle, each in its own encounter."""
    # Both vehicles at every point, and where it is unsafe.
    originals = system.characteristics.with_original_vehicle(settings)
    results = simulate_all_points(system, np.concatenate([originals, settings]))
    at_points = [result.evaluations for result in results]
    is_unsafe = np.stack(list(map(unsafe.of, at_points)))
    worst = worst_points(system, at_points)

    # In words, at the worst point.
    comparisons = []
    for original, vehicle in enumerate(range(len(settings), len(worst))):
        result = results[worst[vehicle]]
        pair = result.evaluations.take([original, vehicle])
        runs = zip(pair.outcome.tolist(), pair.f_safe.tolist(), strict=True)
        endings = [ending_in_words(*run, system.contact) for run in runs]
        sentence = words.AT_POINT(
            point=result.point.name or "of the study",
            original=endings[0],
            changed=endings[1],
        )
        # Without a matrix, the only point has no name.
        failures = compress(system.points, is_unsafe[:, vehicle])
        names = filter(None, (point.name for point in failures))
        comparisons.append((sentence.text, tuple(names)))
    return comparisons
