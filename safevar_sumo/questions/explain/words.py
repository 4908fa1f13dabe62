"""What `explain` says of failures: the values of a cause and how sure it is, who avoids them, and
what counts.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.counterexamples import values_in_words
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.failures import Population
from safevar_sumo.questions.explain.robustness import (
    LEAST_NEIGHBOURS,
    robustness_in_words,
)
from safevar_sumo.questions.preventability import FULL, LETTER
from safevar_sumo.questions.variation import sampled_in_words
from safevar_sumo.questions.words import (
    constraints_in_words,
    counted_in_words,
    encounter_in_words,
    ending_in_words,
    number_of,
    share_in_words,
)
from safevar_sumo.records import NamedValues
from safevar_sumo.study import Study

AVOIDING = {
    LETTER: "A competent driver (as in UN R157) in the same vehicle",
    FULL: "Full braking at the first possible moment",
}
"""Who might have avoided a collision."""
BEYOND = 256
"""Number of vehicles beyond the values of a cause that are simulated."""


def verdict_on_failures(
    evaluator: Evaluator, population: Population, causes: pd.DataFrame
) -> Iterator[str]:
    """How little is enough, and how sure that is."""
    unsafe = population.unsafe
    contact = evaluator.system.contact
    runs = population.evaluations

    # Nothing has to change if the original is unsafe.
    if not evaluator.study.ranges and unsafe.of(population.original)[0]:
        words = unsafe.breach_in_words(population.original)
        yield f"The original vehicle itself {words}: no change is necessary."
        yield unsafe.smaller_demand(population.original)
        return

    # Without a cause, how the worst setting and the original end.
    if causes.empty:
        nearest = runs.take(np.argsort(runs.f_safe, kind="stable")[:1])
        for who, run in (
            ("worst vehicle", nearest),
            ("original vehicle", population.original),
        ):
            if len(run):
                ending = ending_in_words(
                    str(run.outcome[0]), float(run.f_safe[0]), contact
                )
                yield f"The {who} {ending}."
        return
    leading = causes.iloc[0]
    if not leading["changes"]:
        yield "The original vehicle itself is unsafe in this encounter: no change is necessary."
        return

    # Its values, its encounter, and how sure the cause is.
    members = evaluator.characteristics
    boundary = leading["boundary"]
    encounter = encounter_in_words(
        members, leading.get("encounter", {}), are_printed=True
    )
    where = (
        " in an encounter in which the original vehicle is safe" if encounter else ""
    )
    yield f"With {values_in_words(members, boundary)} the vehicle {unsafe.verbs[0]}{where}."
    yield f"The encounter has {encounter.partition(' with ')[2]}." if encounter else ""
    yield _beyond_in_words(evaluator, unsafe, boundary, leading.get("encounter", {}))
    yield robustness_in_words(leading["robust_share"])
    if pd.notna(leading["holds"]):
        holding = f"{leading['holds']} of {leading['fits']}"
        yield f"The cause holds in {holding} parameter sets of the vehicle model."


def _beyond_in_words(
    evaluator: Evaluator, unsafe: Unsafe, cause: NamedValues, encounter: NamedValues
) -> str:
    """The share of vehicles beyond all values of a cause, all else as in the original, that are
    unsafe, in a sentence; empty if there are none, or too few may be simulated.
    """
    members = evaluator.characteristics
    number = evaluator.at_most(BEYOND, 4)
    at_cause = members.setting(cause | encounter, beyond=True)
    ends = np.where(at_cause > members.original, members.upper, members.lower)
    is_open = np.isin(members.names, [*cause]) & (ends != at_cause)
    if number < LEAST_NEIGHBOURS or not is_open.any():
        return ""
    shares = np.random.default_rng(evaluator.seed).random((number, len(members)))
    vehicles = at_cause + np.where(is_open, shares * (ends - at_cause), 0)
    runs = evaluator.evaluate(vehicles, "vehicles beyond the values of a cause")
    share = share_in_words(unsafe.number(runs) / number)
    whose = "these values" if len(cause) > 1 else "this value"
    number_of_them = (
        f"Of {number} vehicles beyond {whose}, all else as in the original,"
    )
    return f"{number_of_them} {share} {unsafe.verbs[1]}."


def others_in_words(
    study: Study, population: Population, complete: int | None, verdicts: pd.DataFrame
) -> Iterator[str]:
    """Up to which size causes are complete, who avoids the failures, and which settings count."""
    if complete:
        yield f"All minimal causes of up to {number_of(complete, 'change')} are found."
    yield avoided_in_words(verdicts)
    over_sets = population.over_sets
    drawn = f"vehicles {sampled_in_words(study)}"
    yield _number_in_words(
        population, drawn if over_sets else "different solutions of the search"
    )
    if over_sets:
        yield over_sets.in_words().strip()
        yield from counted_in_words(study, population.left_out)
    yield from constraints_in_words(study)


def avoided_in_words(verdicts: pd.DataFrame) -> str:
    """What a competent driver, and full braking, would have avoided of the collisions on which each
    has a verdict.
    """
    sentences = []
    examined = f"{len(verdicts):,} examined"
    for name, who in AVOIDING.items():
        number = int(verdicts[name].count())
        which = f"{number:,} examined collisions"
        if number < len(verdicts):
            which = f"{number:,} collisions with a verdict ({examined})"
        if number:
            avoided = f"{int(verdicts[name].sum()):,} of {which}"
            sentences.append(f"{who} would have avoided {avoided}.")
    return " ".join(sentences)


def _number_in_words(population: Population, kind: str) -> str:
    """How many settings are unsafe."""
    unsafe = population.unsafe
    runs = population.evaluations
    number = unsafe.number(runs)
    return f"Of {len(runs):,} {kind}, {unsafe.number_in_words(number)}. {unsafe.remark}".strip()
