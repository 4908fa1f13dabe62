"""The question `explain`: why does a vehicle fail? The answer says which changes cause the failure,
how small a change is enough, whether the failure is robust, and whether a reference driver would
have avoided it.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Annotated

import pandas as pd

from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.budget import LEAST_SETTINGS
from safevar_sumo.questions.case import Results, Subject, are_collisions
from safevar_sumo.questions.causes import (
    BOUNDARIES,
    OTHER_SETS,
    SUBSETS,
    count_distinct_causes,
    count_needed,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.combinations import COMBINATIONS
from safevar_sumo.questions.explain.failures import (
    SAMPLED_SETTINGS,
    TO_EXPLAIN,
    Population,
    choose_failures,
    gather_failures,
)
from safevar_sumo.questions.explain.smallest import (
    MAX_SETTINGS,
    SMALLEST_NUMBERS,
    Smallest,
    draw_staircase,
    smallest_tables,
)
from safevar_sumo.questions.explain.tables import (
    CAUSE_COLUMNS,
    CHARACTERISTIC_COLUMNS,
    DISTINCT_COLUMNS,
    SMALLEST_COLUMNS,
    SOLUTION_COLUMNS,
    STAIRCASE_COLUMNS,
    causes_table,
    failures_frame,
    statistics_tables,
)
from safevar_sumo.questions.explain.tell import (
    failure_sentences,
    other_sentences,
    smallest_sentences,
)
from safevar_sumo.questions.options import Range
from safevar_sumo.questions.over_sets import BY_SET, INTERVALS, planned_over_sets
from safevar_sumo.questions.preventability import (
    COLUMNS as DRIVER_COLUMNS,
    FULL,
    REFERENCE_DRIVERS,
    TITLES,
    assess_sample,
    has_reference_drivers,
)
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.questions.tables import tabulate
from safevar_sumo.questions.words import ALREADY_UNSAFE
from safevar_sumo.records import JsonObject
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import simulate_command

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLLISION_NUMBERS = ("collisions", "avoidable", "unavoidable")
LIMIT = 40_000
"""Approximate number of simulations for the minimal causes of all failures of results. If all
failures would take more, a random sample is analysed.
"""
STUDY_LIMIT, OF_SAMPLE = 12_000, 600
"""The number of simulations for failures that were sampled over the domain of a study. It is larger
if otherwise fewer than `OF_SAMPLE` settings could be simulated at all points.
"""
FOR_ONE = 800
"""Number of settings for each failure that is explained, if few simulations are allowed."""
LATER = {REFERENCE_DRIVERS: 3000, OTHER_SETS: 1000, BOUNDARIES: 3000}
"""The last phases of progress, with their usual numbers of settings."""


@question
@contents(
    "unsafe",
    "settings",
    "failures",
    "other_outcomes",
    "left_out",
    BY_SET,
    INTERVALS,
    "original_outcome",
    "original_degree",
    "rough",
    "analysed",
    "explained",
    *COLLISION_NUMBERS,
    *SMALLEST_NUMBERS,
    lead="causes",
    next="tolerance",
    causes=SMALLEST_COLUMNS | CAUSE_COLUMNS,
    staircase=STAIRCASE_COLUMNS,
    solutions=SOLUTION_COLUMNS,
    characteristics=CHARACTERISTIC_COLUMNS,
    drivers=DRIVER_COLUMNS,
    distinct_causes=DISTINCT_COLUMNS,
)
def explain(
    subject: Subject,
    evaluator: Evaluator,
    *,
    solution: tuple[str, ...] = (),
    unsafe: Criterion = None,
    of_study: bool = False,
    top: Annotated[int, Range(1, 1000)] = 8,
    fits: Annotated[int, Range(0, 1000)] = 20,
    quick: bool = False,
) -> Answer:
    """Ask a STUDY which smallest changes make the vehicle unsafe, or ask results (DIR) what caused
    the failures in these results. For a study, the command sets characteristics to an end of their
    domain (range of values): one by one, in pairs and in larger combinations. For results
    (DIR), the command reduces each failure to the changes that cause the failure, and simulates the
    same vehicle with other drivers.

    Examples: python -m safevar_sumo explain rain and python -m safevar_sumo explain results/rain

    Parameters
    ----------
    solution
        Explain this solution of the results, such as nsga2:3:0; may be repeated. Default: explain
        some failures that have different causes.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: the criterion of the study, else a collision (if nothing collides: half of the
        original vehicle's safety degree).
    of_study
        Ask which smallest changes make the vehicle unsafe, and ignore the unsafe vehicles in the
        results. Default: explain unsafe vehicles in the results.
    top
        Largest number of failures that are examined one by one.
    fits
        Number of parameter sets (calibrations) of the vehicle model in which each cause is checked
        again. 0 checks none.
    quick
        Give a rough answer that proves nothing, with at most an eighth of the usual simulations.
        The answer uses one parameter set of the vehicle model.
    """
    study, of_study = evaluator.study, of_study or isinstance(subject, Study)
    subject = study if of_study else subject
    limit = _plan(subject, evaluator, fits)
    fits = 0 if evaluator.budget.is_few else fits

    if evaluator.settings_left is not None:
        top = max(1, min(top, evaluator.settings_left // FOR_ONE))
    population = gather_failures(subject, evaluator, solution, unsafe, fits)
    runs = population.evaluations
    # If the original vehicle is unsafe, no change is a cause of a failure. If encounters are
    # ranges, the original may still be safe in the encounter of a failure.
    is_caused = bool(study.ranges or not population.unsafe.of(population.original)[0])

    # With few simulations, the minimal causes of failures get a quarter of what is left.
    if evaluator.settings_left is not None:
        limit = evaluator.settings_left // 4 * len(evaluator.system.points)
    top = 0 if of_study else top
    reasons, sample, causes, complete = choose_failures(
        population, evaluator, limit, top
    )
    if not is_caused:
        causes = {row: [] for row in causes}
    of_chosen = [causes[row] for row in reasons]
    of_sample = [causes[row] for row in sample]
    smallest = None
    if of_study and is_caused:
        sampled = list(chain.from_iterable(of_sample))
        smallest = Smallest.of(evaluator, population.unsafe, fits, sampled)
    changed = evaluator.characteristics.changed(runs.settings[sample])
    necessity = count_needed(
        evaluator.characteristics, changed, of_sample, len(population.rows)
    )
    necessity = necessity if is_caused else necessity.head(0)

    has_drivers = has_reference_drivers(evaluator)
    verdicts, collisions = assess_sample(
        evaluator, runs.take(runs.collided & has_drivers)
    )

    solutions = failures_frame(population, evaluator, reasons)
    distinct = count_distinct_causes(evaluator.characteristics, of_sample)
    if of_study:
        leading_tables = smallest_tables(smallest)
    else:
        causes_of_chosen = causes_table(
            population, evaluator, fits, solutions, of_chosen, distinct
        )
        leading_tables = {"causes": causes_of_chosen}
    tables = {
        **leading_tables,
        "solutions": tabulate(
            "The failures that were examined one by one", SOLUTION_COLUMNS, solutions
        ),
        **statistics_tables(necessity, len(sample), verdicts, collisions, distinct),
    }
    numbers = _counts(population, subject, len(sample), len(solutions))
    numbers |= _collision_numbers(verdicts, collisions if has_drivers else None)
    leading = failure_sentences(
        evaluator, population, tables["causes"].frame, len(sample)
    )
    if smallest is not None:
        numbers |= smallest.numbers
        leading = smallest_sentences(smallest, evaluator, population.unsafe)
    notes = other_sentences(study, population, complete, verdicts)
    failures = []
    if not is_caused:
        breach = population.unsafe.breach_in_words(population.original)
        failures.append(ALREADY_UNSAFE(breach=breach).text)
    return Answer(
        question="explain",
        study=study,
        verdict=Verdict([*leading, *notes]),
        numbers=numbers,
        tables=tables,
        failures=tuple(failures),
        next="" if is_caused else simulate_command(study),
        draw=draw_staircase if smallest is not None else draw_needed,
    )


def _plan(subject: Subject, evaluator: Evaluator, fits: int) -> int:
    """Plan the phases of progress. Returns the number of simulations for the minimal causes of
    failures.
    """
    points = len(evaluator.system.points)
    if isinstance(subject, Study):
        limit = evaluator.budget.by_effort(max(STUDY_LIMIT, OF_SAMPLE * points))
        planned = planned_over_sets(
            subject, TO_EXPLAIN, evaluator.budget.by_effort(SAMPLED_SETTINGS), fits
        )
        planned[COMBINATIONS] = evaluator.budget.by_effort(MAX_SETTINGS)
    else:
        limit = evaluator.budget.by_effort(LIMIT)
        planned = {TO_EXPLAIN: float(len(subject.solutions))}
    later = {name: evaluator.budget.by_effort(number) for name, number in LATER.items()}
    evaluator.begin(
        {**planned, SUBSETS: limit / points, **later}, minimum=LEAST_SETTINGS
    )
    return limit


def _counts(
    population: Population, subject: Subject, analysed: int, explained: int
) -> JsonObject:
    """The numbers of the answer on settings and failures.

    `settings`, `failures`, `analysed` and `explained` count settings and failures. The unsafe share
    of sampled settings is stated for each parameter set. `original_outcome` and `original_degree`
    say how the original vehicle ends. `left_out` is the number of collisions that the search
    simulated, but did not return, if no solution collides.
    """
    runs = population.evaluations
    original = population.original
    over_sets = population.over_sets
    failures = population.unsafe.number(runs)
    by_set = dict.fromkeys((BY_SET, INTERVALS))
    if over_sets is not None:
        by_set = over_sets.numbers(failures / max(len(runs), 1))
    omissions = 0
    if (
        isinstance(subject, Results)
        and not subject.study.origin.point
        and not runs.collided.any()
    ):
        omissions = int(are_collisions(subject.evaluations).sum())
    return {
        "unsafe": str(population.unsafe),
        "settings": len(runs),
        "failures": failures,
        "other_outcomes": population.otherwise,
        "left_out": omissions,
        **by_set,
        "original_outcome": str(original.outcome[0]),
        "original_degree": float(original.f_safe[0]),
        "analysed": analysed,
        "explained": explained,
    }


def _collision_numbers(verdicts: pd.DataFrame, collisions: int | None) -> JsonObject:
    """The numbers of all collisions, of examined collisions that some driver avoids, and of
    examined collisions that not even full braking avoids. All are None if `collisions` is None,
    because no other driver drove.
    """
    if collisions is None:
        return dict.fromkeys(COLLISION_NUMBERS)
    is_avoided = (verdicts[list(TITLES)] == 1).any(axis=1)
    unavoidable = verdicts[FULL].notna() & ~is_avoided
    numbers = collisions, int(is_avoided.sum()), int(unavoidable.sum())
    return dict(zip(COLLISION_NUMBERS, numbers, strict=True))


def draw_needed(answer: Answer) -> Figure:
    """Draw how often each characteristic is needed, and how often it is changed."""
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        GREY,
        SKY_BLUE,
        escape_dollars,
        new_figure,
    )

    # Bars are drawn from the bottom up: the most necessary characteristic, which comes first in the
    # table, must be the last bar.
    frame = answer.tables["characteristics"].iloc[::-1]
    size = (6.4, 1.4 + 0.3 * max(len(frame), 4))
    figure, ((axis,),) = new_figure(
        f"{answer.study.name}: which changed characteristics are necessary", 1, 1, size
    )
    names = list(map(escape_dollars, frame["characteristic"]))
    for column, label, colour, height in (
        ("changed", "changed by the search", GREY, 0.8),
        ("in_some", "part of some minimal cause", SKY_BLUE, 0.5),
        ("needed", "necessary (part of every minimal cause)", BLUE, 0.24),
    ):
        axis.barh(names, 100 * frame[column], height=height, color=colour, label=label)
    axis.set_xlim(0, 100)
    axis.set_xlabel(f"share of {answer.numbers['analysed']} failures [%]")
    axis.grid(visible=False, axis="y")
    figure.legend(
        loc="outside lower center", ncols=3, frameon=False, fontsize=FONT_SIZE
    )
    return figure
