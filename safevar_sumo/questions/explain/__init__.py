"""Why does a vehicle fail? Which changes cause the failure, how small a change is enough, is the failure robust, and
would a reference driver have avoided it?
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np
import pandas as pd

from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Count, Criterion, Range, question
from safevar_sumo.questions.case import Case, are_collisions
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.across_fits import Ranges, conclusions_across_fits
from safevar_sumo.questions.explain.causes import (
    BOUNDARIES,
    SUBSETS,
    Cause,
    count_distinct_causes,
    count_needed,
    find_limits,
    settings_of,
)
from safevar_sumo.questions.explain.failures import (
    TO_EXPLAIN,
    Population,
    Reasons,
    choose_failures,
    compare_at_cells,
    compare_at_points,
    find_failures,
)
from safevar_sumo.questions.explain.margins import MARGINS, find_margins
from safevar_sumo.questions.explain.moved import BORDERS, COLUMNS as MOVED_COLUMNS, find_moved_borders
from safevar_sumo.questions.explain.robustness import STEP_FACTORS, robust_shares, robustness_in_words
from safevar_sumo.questions.model_spread import FITS_AT_ONCE
from safevar_sumo.questions.preventability import (
    COLUMNS as DRIVER_COLUMNS,
    FULL,
    LETTER,
    REFERENCE_DRIVERS,
    TITLES,
    avoided_by,
    avoided_shares,
    drivers_frame,
    judge_collisions,
    judge_sample,
)
from safevar_sumo.questions.tables import Column, Columns, tabulate, with_interval
from safevar_sumo.questions.words import (
    constraints_in_words,
    counted_in_words,
    encounter_in_words,
    ending_in_words,
    join_phrases,
    number_of,
    share_in_words,
)
from safevar_sumo.records import BoolArray, JsonObject, Outcome
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_DISTINCT = 10
"""Maximum number of distinct causes in their table."""
COLLISION_NUMBERS = ("collisions", "avoidable", "unavoidable")
SOLUTIONS, DRAWN = "different solutions of the search", "vehicles drawn from the whole domain"
"""What the settings are of which some are unsafe."""
CAUSE_COLUMNS: Columns = {
    "solution": "handle of the failure",
    "changes": Column("", "a smallest set of its changes that is unsafe by itself", ".5g", is_shown=False),
    "encounter": Column("", "the encounter, in which the original vehicle is safe", ".5g"),
    "boundary": Column("", "the values if all these changes are scaled back as far as they stay unsafe", ".5g"),
    "single_boundary": Column("", "of each, the value if this change alone is scaled back", ".5g", is_shown=False),
    "fraction": Column("-", "factor by which all changes are scaled at the boundary", ".3f", is_shown=False),
    "end": Column("", "what lies just below the boundary", is_shown=False),
    "size": Column("", "number of changes", is_shown=False),
    "elsewhere": "whether these changes are unsafe in the original encounter, too",
    "outcome": Column("", "outcome with these changes only", is_shown=False),
    "safety_degree": Column("m", "safety degree with these changes only; -m/s on a collision", is_shown=False),
    "robust_share": Column("-", "share of the neighbours of these changes that are unsafe, too", ".2f"),
    "fits_holding": "number of fitted vehicle models in which these changes are a cause, too",
    "avoided_by": Column("", "weakest reference driver who avoids the failure, in the same vehicle", is_shown=False),
}
OF_ENCOUNTER = ("encounter", "elsewhere")
"""Columns of a study that searches its scenario."""
SOLUTION_COLUMNS: Columns = {
    "solution": "handle",
    "reason": "why it is explained",
    "outcome": Column("", "outcome", is_shown=False),
    "safety_degree": Column("m", "safety degree; in -m/s on a collision", ".2f"),
    "changed": "number of changes",
    "largest_change": Column("-", "largest change, as a share of the original value", is_shown=False),
    "robust_share": Column("-", "share of its neighbours that are unsafe, too", ".2f"),
    "ends": Column("", "how the original vehicle and this one end, where this one is worst", is_shown=False),
    "points": Column("", "points at which it is unsafe; of a rating, cells whose colour is worse", is_shown=False),
    "avoided_by": "weakest reference driver who avoids it, in the same vehicle; nobody: unavoidable",
}
CHARACTERISTIC_COLUMNS: Columns = {
    "characteristic": "characteristic of the vehicle",
    "changed": Column("-", "share of the failures that change it", ".2f"),
    **with_interval("needed", Column("-", "share of the failures of which every minimal cause contains it", ".2f")),
    "in_some": Column("-", "share of the failures of which some minimal cause contains it", ".2f"),
}
"""The interval is Clopper and Pearson's, 95 %, if only a sample of the failures was analysed, else the share itself."""
DISTINCT_COLUMNS: Columns = {
    "cause": "a minimal cause, without the sizes of its changes",
    "failures": "failures with this cause",
    "share": Column("-", "their share", ".2f"),
}


@question
@contents(
    *("unsafe", "settings", "failures", "other_outcomes", "left_out", "original_outcome", "original_degree"),
    *("analysed", "explained", *COLLISION_NUMBERS, "fits", "unsafe_in_fits"),
    causes=CAUSE_COLUMNS,
    solutions=SOLUTION_COLUMNS,
    characteristics=[*CHARACTERISTIC_COLUMNS, "needed_in_fits"],
    drivers=[*DRIVER_COLUMNS, "share_in_fits"],
    margins=MARGINS,
    moved=MOVED_COLUMNS,
    distinct_causes=DISTINCT_COLUMNS,
)
def explain(
    subject: Study | Case,
    evaluator: Evaluator,
    *,
    solution: tuple[str, ...] = (),
    unsafe: Criterion = None,
    top: Annotated[int, Range(1, 1000)] = 8,
    limit: Count = 40_000,
    fits: Annotated[int, Range(0, 1000)] = 20,
) -> Answer:
    """Explain failures: which changes cause them, how small a change is enough, and who would have avoided them.

    Of a study without results, failures among settings drawn from its whole domain are explained.

    Parameters
    ----------
    solution
        Handle of a solution, such as nsga2:3:0; may be repeated. By default the robust failure with the fewest changes,
        those with the fewest and the smallest changes, the most severe one, and one of each distinct cause.
    unsafe
        What is unsafe: a collision, a safety degree below X, or at most X points of a rating.
    top
        Largest number of failures that are explained.
    limit
        Approximate number of simulations for the minimal causes of all failures; if all would take more, a random
        sample is analysed.
    fits
        Number of vehicle models that fit the published data about as well (sets of [spread]) with which each conclusion
        is drawn again; 0 leaves this out.
    """
    evaluator.plan(TO_EXPLAIN, SUBSETS, REFERENCE_DRIVERS, FITS_AT_ONCE, BOUNDARIES, BORDERS)
    study = evaluator.study
    population = find_failures(subject, evaluator, solution, unsafe)
    runs = population.evaluations
    reasons, sample, causes = choose_failures(population, evaluator, limit, top)
    # Of an unsafe original no change is a cause; in another encounter it may be safe.
    is_unsafe_original = not study.scenario.search and bool(population.unsafe.of(population.original)[0])
    if is_unsafe_original:
        causes = {row: [] for row in causes}
    changed = evaluator.characteristics.changed(runs.settings[sample])
    needed = count_needed(evaluator.characteristics, changed, [causes[row] for row in sample], len(population.rows))
    needed = needed.head(0) if is_unsafe_original else needed
    # In a rating every vehicle collides in some cell, so that nothing is told of reference drivers.
    verdicts, collisions = judge_sample(evaluator, runs.take(runs.collided & (not is_rated(study))))
    of_chosen = [causes[row] for row in reasons]
    holding = list[BoolArray]()
    ranges = Ranges()
    if fits and study.spread and len(runs):
        shares = needed.set_index("characteristic")["needed"], avoided_shares(verdicts)
        holding, ranges = conclusions_across_fits(evaluator, fits, runs, population.unsafe, of_chosen, *shares)
    solutions = _solutions_frame(population, evaluator, reasons)
    tables = {
        "causes": _causes_table(population, evaluator, holding, solutions, of_chosen),
        "solutions": tabulate("The failures explained", SOLUTION_COLUMNS, solutions),
        **_statistics(evaluator, needed, drivers_frame(verdicts, collisions), ranges, len(sample), len(verdicts)),
        "margins": tabulate("By the margin of the original", MARGINS, find_margins(population, evaluator, limit)),
        "moved": _moved_table(evaluator, of_chosen),
        "distinct_causes": _distinct_table(evaluator, [causes[row] for row in sample]),
    }
    numbers = {
        **_counts(population, subject),
        "analysed": len(sample),
        "explained": len(solutions),
        **(dict.fromkeys(COLLISION_NUMBERS) if is_rated(study) else _collision_numbers(verdicts, collisions)),
        "fits": len(holding),
        "unsafe_in_fits": ranges.get(("unsafe", "")),
    }
    kind = DRAWN if isinstance(subject, Study) else SOLUTIONS
    sentences = [_verdict(evaluator, population, kind, len(holding), tables["causes"]), _avoided_in_words(verdicts)]
    sentences += counted_in_words(study, len(population.left_out)) if kind == DRAWN else []
    verdict = " ".join([*filter(None, sentences), *constraints_in_words(study)])
    return Answer(question="explain", study=study, verdict=verdict, numbers=numbers, tables=tables, draw=draw_needed)


def _counts(population: Population, subject: Study | Case) -> JsonObject:
    """The numbers of settings, how the original vehicle ends, and the number of collisions that the search simulated
    but its objectives leave out of the solutions.
    """
    runs = population.evaluations
    original = population.original
    left_out = 0
    if isinstance(subject, Case) and not subject.study.origin.point and not runs.collided.any():
        left_out = int(are_collisions(subject.evaluations).sum())
    return {
        "unsafe": str(population.unsafe),
        "settings": len(runs),
        "failures": int(population.unsafe.of(runs).sum()),
        "other_outcomes": population.otherwise,
        "left_out": left_out,
        "original_outcome": str(original.outcome[0]),
        "original_degree": float(original.f_safe[0]),
    }


def _collision_numbers(verdicts: pd.DataFrame, collisions: int) -> JsonObject:
    """The numbers of all collisions, of those judged that some driver avoids, and that even full braking does not."""
    is_avoided = (verdicts[[*TITLES]] == 1).any(axis=1)
    unavoidable = verdicts[FULL].notna() & ~is_avoided
    return dict(zip(COLLISION_NUMBERS, (collisions, int(is_avoided.sum()), int(unavoidable.sum())), strict=True))


def _solutions_frame(population: Population, evaluator: Evaluator, reasons: Reasons) -> pd.DataFrame:
    """A row of `SOLUTION_COLUMNS` for each chosen failure."""
    if not reasons:
        return pd.DataFrame(columns=[*SOLUTION_COLUMNS])
    study = evaluator.study
    failures = population.evaluations.take(list(reasons))
    settings = failures.settings
    unsafe = population.unsafe
    if is_rated(study):  # each neighbour is simulated in all cells
        factors = STEP_FACTORS[:1]
        comparisons = compare_at_cells(evaluator, settings)
    else:
        factors = STEP_FACTORS
        comparisons = compare_at_points(assemble(study), settings, unsafe)
    is_judged = failures.collided & (not is_rated(study))
    judged = iter(judge_collisions(evaluator, failures.take(is_judged)).to_dict("records"))
    columns = {
        "solution": [population.names[row] for row in reasons],
        "reason": [*reasons.values()],
        "outcome": failures.outcome,
        "safety_degree": failures.f_safe,
        "changed": failures.f_num_diff.astype(int),
        "largest_change": failures.f_diff,
        "robust_share": robust_shares(evaluator, settings, assemble(study).step, unsafe, factors).mean(axis=1),
        "ends": [sentence for sentence, _ in comparisons],
        "points": [list(points) for _, points in comparisons],
        "avoided_by": [avoided_by(next(judged)) if flag else None for flag in is_judged],
    }
    return pd.DataFrame(columns)


def _causes_table(
    population: Population,
    evaluator: Evaluator,
    holding: Sequence[BoolArray],
    solutions: pd.DataFrame,
    causes_of: Sequence[Sequence[Cause]],
) -> pd.DataFrame:
    """A row of `CAUSE_COLUMNS` for each cause of each chosen failure; of a failure the most robust one first."""
    study = evaluator.study
    unsafe = population.unsafe
    causes = [cause for group in causes_of for cause in group]
    robust = np.full(len(causes), np.nan)
    if causes and not is_rated(study):
        settings = settings_of(evaluator.characteristics, causes)
        robust = robust_shares(evaluator, settings, assemble(study).step, unsafe).mean(axis=1)
    shrunk = find_limits(evaluator, causes, unsafe)
    fits_holding = np.sum(holding, axis=0)
    elsewhere = np.zeros(len(causes), dtype=bool)
    if causes and study.scenario.search:
        at_original = [cause._replace(encounter={}) for cause in causes]
        there = evaluator.evaluate(
            settings_of(evaluator.characteristics, at_original), "causes in the original encounter"
        )
        elsewhere = unsafe.of(there)
    numbers = np.repeat(range(len(solutions)), list(map(len, causes_of)))
    rows = []
    for index in np.lexsort([-robust, numbers]).tolist():
        rows.append(
            {
                **solutions[["solution", "avoided_by"]].iloc[numbers[index]],
                **causes[index]._asdict(),
                **shrunk[index]._asdict(),
                "size": len(causes[index].changes),
                "elsewhere": bool(elsewhere[index]),
                "robust_share": robust[index],
                "fits_holding": int(fits_holding[index]) if holding else None,
            }
        )
    frame = pd.DataFrame(rows, columns=[*CAUSE_COLUMNS]).astype({"fits_holding": "Int64"})
    omitted = () if study.scenario.search else OF_ENCOUNTER
    columns = {name: column for name, column in CAUSE_COLUMNS.items() if name not in omitted}
    return tabulate("Minimal causes, all else as in the original", columns, frame)


def _statistics(
    evaluator: Evaluator, needed: pd.DataFrame, drivers: pd.DataFrame, ranges: Ranges, failures: int, collisions: int
) -> dict[str, pd.DataFrame]:
    """The tables of characteristics and of drivers, with ranges over the fitted vehicle models."""
    in_fits = Column("-", "range over the fitted vehicle models", ".2f")
    of_characteristics = [ranges.get(("needed", str(name))) for name in needed["characteristic"]]
    of_drivers = [ranges.get(("avoided", str(name))) for name in drivers["driver"]]
    return {
        "characteristics": tabulate(
            f"Changed and needed, in {number_of(failures, 'failure')}",
            {**CHARACTERISTIC_COLUMNS, "needed_in_fits": in_fits},
            needed.assign(needed_in_fits=pd.Series(of_characteristics, dtype=object)),
        ),
        "drivers": tabulate(
            f"Other drivers in the same vehicle, in {number_of(collisions, 'collision')}",
            {**DRIVER_COLUMNS, "share_in_fits": in_fits},
            drivers.assign(share_in_fits=pd.Series(of_drivers, dtype=object)),
        ),
    }


def _moved_table(evaluator: Evaluator, causes_of: Sequence[Sequence[Cause]]) -> pd.DataFrame:
    causes = [] if is_rated(evaluator.study) else [cause for group in causes_of for cause in group]
    title = "Avoidable in a new car, no longer in this one: a competent driver, any braking of a leader"
    return tabulate(title, MOVED_COLUMNS, find_moved_borders(evaluator, causes))


def _distinct_table(evaluator: Evaluator, causes: Sequence[Sequence[Cause]]) -> pd.DataFrame:
    distinct = count_distinct_causes(evaluator.characteristics, causes)
    rows = distinct.assign(cause=distinct["cause"].map(", ".join)).head(MAX_DISTINCT)
    return tabulate(f"The most frequent of {number_of(len(distinct), 'distinct cause')}", DISTINCT_COLUMNS, rows)


def _verdict(evaluator: Evaluator, population: Population, kind: str, fits: int, causes: pd.DataFrame) -> str:
    """How little is enough, how sure that is, and how many settings are unsafe."""
    unsafe = population.unsafe
    contact = assemble(evaluator.study).contact
    runs = population.evaluations
    counts = f"{np.count_nonzero(unsafe.of(runs))} of {len(runs)} {kind} are unsafe ({unsafe.description})."
    if not evaluator.study.scenario.search and unsafe.of(population.original)[0]:
        words = unsafe.breach_in_words(population.original)
        demand = f" {unsafe.smaller_demand}".rstrip()
        return f"The original itself {words}: no change is needed.{demand} {counts}"
    if causes.empty:
        nearest = runs.take(np.argsort(runs.f_safe, kind="stable")[:1])
        ends = [
            f"The {who} {ending_in_words(str(run.outcome[0]), float(run.f_safe[0]), contact)}."
            for who, run in (("worst", nearest), ("original", population.original))
            if len(run)
        ]
        return " ".join([counts, *ends])
    leading = causes.iloc[0]
    if not leading["changes"]:
        return f"The original itself is unsafe in this encounter: no change is needed. {counts}"
    limits = [
        f"{item.short_name} {'above' if value > item.original else 'below'} {item.text(value)}{item.suffix}"
        for item in evaluator.characteristics
        if (value := leading["boundary"].get(item.name)) is not None
    ]
    encounter = encounter_in_words(evaluator.characteristics, leading.get("encounter", {}))
    where = f"{encounter}, where the original is safe," if encounter else ""
    sure = [robustness_in_words(leading["robust_share"])]
    sure += [f"in {leading['fits_holding']} of {fits} fitted vehicle models"] if fits else []
    notes = f" ({'; '.join(filter(None, sure))})" if any(sure) else ""
    verb = "collides" if str(unsafe) == Outcome.COLLISION else "is unsafe"
    return f"With {join_phrases(limits)}{where} the vehicle {verb}{notes}. {counts}"


def _avoided_in_words(verdicts: pd.DataFrame) -> str:
    """What a competent driver, and full braking, would have avoided."""
    shares = avoided_shares(verdicts)
    titles = {LETTER: "a competent driver", FULL: "full braking at the first possible moment"}
    phrases = [f"{title} avoids {share_in_words(shares[name])}" for name, title in titles.items() if name in shares]
    number = number_of(len(verdicts), "collision")
    return f"In the same vehicle, of {number} {join_phrases(phrases)}." if phrases else ""


def draw_needed(answer: Answer) -> Figure:
    """How often each characteristic is needed, beside how often it is changed."""
    from safevar_sumo.questions.figures import BLUE, FONT_SIZE, GREY, SKY_BLUE, escape_dollars, new_figure

    frame = answer.tables["characteristics"].iloc[::-1]  # bars are drawn from the bottom up
    size = (6.4, 1.4 + 0.3 * max(len(frame), 4))
    figure, ((axis,),) = new_figure(f"{answer.study.name}: changed and needed", 1, 1, size)
    names = [escape_dollars(name) for name in frame["characteristic"]]
    for column, label, colour, height in (
        ("changed", "changed", GREY, 0.8),
        ("in_some", "in some minimal cause", SKY_BLUE, 0.5),
        ("needed", "needed: in every minimal cause", BLUE, 0.24),
    ):
        axis.barh(names, 100 * frame[column], height=height, color=colour, label=label)
    axis.set_xlim(0, 100)
    axis.set_xlabel(f"share of {answer.numbers['analysed']} failures [%]")
    axis.grid(visible=False, axis="y")
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=FONT_SIZE)
    return figure
