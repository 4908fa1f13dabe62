"""Chooses the failures that `explain` explains: failures that matter among the solutions of
results, or among settings that are sampled from a study's whole domain. Each chosen failure is
compared with the original vehicle in the same encounter.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress, islice
from typing import NamedTuple

import numpy as np
from numpy.random import default_rng

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.case import Results, Subject
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
"""The phase of progress in which the vehicles are simulated from which failures are chosen."""
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
"""Number of settings that are sampled from the whole domain if there are no results."""
SAMPLED_SIMULATIONS, LEAST_SAMPLED_SETTINGS = 40_000, 1024
"""A setting is simulated at all points of a matrix. If this takes more simulations than the first
number, fewer settings are sampled, but at least the second number.
"""


class Population(NamedTuple):
    """Evaluated settings, also safe ones, and the failures among them.

    Attributes
    ----------
    original
        The evaluation of the original vehicle.
    evaluations
        The evaluations of the settings. Equal solutions of several runs are one row.
    names
        For each row, the handle of the solution, or `drawn:N` for a sampled setting.
    unsafe
        The criterion of an unsafe vehicle.
    rows
        The rows of the failures: the unsafe rows or, if the user names solutions, these.
    is_named
        Whether the user names solutions.
    otherwise
        Number of rows whose outcome differs from that in the results.
    omissions
        Number of sampled settings that are left out, because the original vehicle does not keep its
        margin in their encounter.
    over_sets
        The unsafe shares of sampled settings over the parameter sets; None for solutions.
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
    """Evaluate all solutions of results, or sampled settings of a study. For a study, sampled
    vehicles are also simulated with the first `fits` parameter sets.

    Parameters
    ----------
    solutions
        Handles of the solutions that the user names, such as nsga2:3:0.
    criterion
        The criterion that the user states; None for the default.

    Raises
    ------
    InputError
        If the criterion or a handle cannot be read, or a handle is no solution of the results.
    NobodyMoved
        If no vehicle moved.
    """
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

    # Solutions are simulated again, because other files or versions may give other outcomes.
    evaluations = evaluator.evaluate(settings, TO_EXPLAIN)
    evaluator.tally.refuse_standing()
    unsafe = (
        evaluator.checked(criterion)
        if criterion
        else Unsafe.default_among(evaluations, original)
    )
    is_other = (evaluations.outcome != recorded) & (recorded != UNKNOWN)

    omissions = 0
    over_sets = None
    is_counted = ~evaluations.standing
    if named:
        is_counted[:] = True
    if isinstance(subject, Study):
        omissions = int(evaluations.infeasible.sum())
        is_counted &= ~evaluations.infeasible
        vehicles = VariationModel(subject).draw(
            VEHICLES, default_rng(subject.search.seed)
        )
        over_sets = SharesOverSets.of(evaluator, unsafe, vehicles, fits=fits)
    evaluations = evaluations.take(is_counted)
    names = list(compress(names, is_counted))

    # A solution that the user names is explained even if it is safe.
    rows = (
        list(range(len(set(named))))
        if named
        else np.flatnonzero(unsafe.of(evaluations)).tolist()
    )
    counted = bool(named), int(is_other.sum()), omissions, over_sets
    return Population(original, evaluations, names, unsafe, rows, *counted)


Candidates = tuple[FloatArray, list[str], TextArray]
"""M settings among which failures are sought, shape (M, n), their names, and their outcomes in the
results, shape (M,); `UNKNOWN` without results.
"""


def _drawn_from(study: Study, evaluator: Evaluator) -> Candidates:
    """Sampled settings, which vary as the study says, and pass the study's filter."""
    affordable = SAMPLED_SIMULATIONS // len(evaluator.system.points)
    number = min(SAMPLED_SETTINGS, max(affordable, LEAST_SAMPLED_SETTINGS))
    # With few simulations, an eighth finds failures: most are needed to find the causes.
    number = evaluator.of_stage(number, 8)
    sampled_settings = VariationModel(study).draw(
        number, default_rng(study.search.seed), filtered=True
    )
    settings = evaluator.characteristics.filter(sampled_settings)
    names = [f"drawn:{row}" for row in range(len(settings))]
    return settings, names, np.full(len(settings), UNKNOWN)


def _solutions_of(case: Results, named: Sequence[SolutionId]) -> Candidates:
    """The different solutions of results. The solutions that the user names come first."""
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


def choose_failures(
    population: Population, evaluator: Evaluator, limit: int, top: int
) -> tuple[Reasons, list[int], dict[int, list[Cause]], int | None]:
    """Choose at most `top` failures that matter, and a sample of all failures, and find their
    minimal causes. If the user names solutions, these are all chosen, and are the sample.

    The failures that matter are a failure for each of `REASONS`, and then, for each minimal cause
    that these failures do not have, the simplest failure with this cause. The sample has all
    failures if their causes take at most about `limit` simulations.

    The results are:

    - the reasons for which failures are chosen, by row,
    - the rows of the sample,
    - the minimal causes of chosen and sampled failures, by row,
    - the number of changes up to which all minimal causes were found; None if all were found.
    """
    # A setting takes a simulation at every point: the limit becomes a number of settings.
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

    analysed = sorted({*sample, *reasons})
    settings = runs.settings[analysed]
    groups = find_minimal_causes(evaluator, settings, population.unsafe, limit)
    causes = dict(zip(analysed, groups, strict=True))
    numbers = runs.f_num_diff[analysed].astype(int).tolist()
    complete = largest_complete(numbers, limit)
    complete_up_to = complete if complete < max(numbers, default=0) else None
    if population.is_named:
        return reasons, sample, causes, complete_up_to

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
    return reasons, sample, causes, complete_up_to


def _failures_that_matter(population: Population) -> Reasons:
    """The most extreme failure for each of `REASONS`; a failure may have several reasons."""
    reasons = Reasons()
    failures = population.evaluations.take(population.rows)
    for choice, reason in REASONS.items() if population.rows else ():
        columns = map(failures.column, reversed(CHOICES[choice]))
        order = np.lexsort(list(columns))
        row = population.rows[order[0]]
        reasons[row] = f"{reasons[row]}; {reason}" if row in reasons else reason
    return reasons


PointComparison = tuple[str, list[str]]
"""A sentence on how the runs of the original vehicle and of a failure end at the failure's worst
point; and the names of the points of a matrix at which the failure is unsafe, in the study's order.
"""


def compare_at_points(
    system: System, settings: FloatArray, unsafe: Unsafe
) -> list[PointComparison]:
    """Compare M settings, shape (M, n), with the original vehicle in the setting's encounter."""
    originals = system.characteristics.with_original_vehicle(settings)
    results = simulate_all_points(system, np.concatenate([originals, settings]))
    at_points = [result.evaluations for result in results]
    is_unsafe = np.stack(list(map(unsafe.of, at_points)))
    worst = worst_points(system, at_points)

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
        names = [point.name for point in failures if point.name]
        comparisons.append((sentence.text, names))
    return comparisons
