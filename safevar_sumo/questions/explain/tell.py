"""Makes the sentences of `explain`: chooses templates, and fills them with what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.metrics.words import runs_in_words
from safevar_sumo.questions.counterexamples import values_in_words
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import words
from safevar_sumo.questions.explain.combinations import Enumeration
from safevar_sumo.questions.explain.failures import Population
from safevar_sumo.questions.explain.robustness import LEAST_NEIGHBOURS, MIN_ROBUST_SHARE
from safevar_sumo.questions.explain.smallest import Smallest
from safevar_sumo.questions.preventability import FULL, LETTER
from safevar_sumo.questions.sentence import Sentence, Sentences, answer
from safevar_sumo.questions.variation import sampled_in_words
from safevar_sumo.questions.words import (
    ALREADY_UNSAFE,
    constraints_in_words,
    count_in_words,
    counted_in_words,
    ending_in_words,
    join_phrases,
    notes_on,
    number_of,
    percentage,
    place_in_words,
)
from safevar_sumo.records import NamedValues
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

BEYOND = 256
"""Number of simulated vehicles whose changes are larger than those of a cause."""
NUMBERS = [
    "none",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
]
AVOIDING = {LETTER: words.COMPETENT_DRIVER, FULL: words.FULL_BRAKING}
"""The drivers who might have avoided a collision, and the sentences about them."""


def smallest_sentences(
    smallest: Smallest, evaluator: Evaluator, unsafe: Unsafe
) -> Sentences:
    """Yield the sentences on the smallest unsafe changes of a study, on how sure they are, and on
    what was simulated.
    """
    members = evaluator.characteristics
    yield from _leading_of_study(smallest, members, unsafe)
    for size, number in smallest.at_ends.simulated.items():
        if number:
            yield _of_size(smallest.at_ends, unsafe, size)
    yield from _steps(smallest.steps[1:], unsafe, has_repeats=evaluator.has_repeats)
    yield from _containing(smallest)
    yield from _in_none(smallest, members)
    if encounters := len(evaluator.critical_encounters):
        yield words.SCOPE(number=encounters)


def _leading_of_study(
    smallest: Smallest, members: CharacteristicSet, unsafe: Unsafe
) -> Sentences:
    """Yield the sentences on the leading cause, and on how sure it is. The leading cause is the
    first of the table: it has the fewest changes and, among several such causes, is most robust.
    """
    table = smallest.table
    if not smallest.at_ends.tried:
        yield words.TOO_FEW
        return
    if table.empty and smallest.at_ends.causes:
        yield words.NOT_CONFIRMED
        return
    if table.empty:
        largest = max(smallest.at_ends.simulated)
        yield words.NOTHING_FOUND(
            unsafe=unsafe.event,
            changes=_size_in_words(largest),
        )
        return
    leading = table.to_dict("records")[0]
    if not leading["size"]:
        yield words.UNSAFE_IN_ENCOUNTER
        return
    share = leading["begins_at"]
    templates = _templates(members, leading["boundary"], share)
    yield _enough(templates, members, unsafe, leading, share)
    if number_of_others := (table["size"] == leading["size"]).sum() - 1:
        yield words.OTHERS(causes=number_of(number_of_others, "further cause"))

    if pd.notna(leading["safe_again"]):
        yield words.GAP(share=percentage(leading["safe_again"]))
    if leading["causes"] != leading["boundary"]:
        yield from _checked(members, leading)
    yield from _sureness(leading)


def _checked(members: CharacteristicSet, row: Mapping[Any, Any]) -> Sentences:
    """Say with which values the cause in a row of the table was checked."""
    if pd.notna(row["robust_share"]):
        checks = "similar vehicles"
        if pd.notna(row["holds"]):
            checks += " and of other parameter sets"
        changes = values_in_words(members, row["causes"])
        yield words.CHECKED_WITH(checks=checks, changes=changes)


def _templates(
    members: CharacteristicSet, values: NamedValues, begins_at: float
) -> Sequence[Sentence]:
    """The sentences that say where a cause begins: at ends of the domain, at a share of the way to
    the ends, or (if the share is NaN) at certain values.
    """
    are_ends = all(
        values[item.name] in (item.lower, item.upper)
        for item in members
        if item.name in values
    )
    if are_ends:
        return words.AT_ENDS
    return words.CHANGES if np.isnan(begins_at) else words.ON_THE_WAY


def _enough(
    templates: Sequence[Sentence],
    members: CharacteristicSet,
    unsafe: Unsafe,
    row: Mapping[Any, Any],
    share: float = 1.0,
) -> Sentence:
    """Say that the changes in a row of the table of causes are enough for an unsafe vehicle or, if
    runs differ, in how many of its fresh runs the vehicle fails. `templates` has the sentence for
    one change and the sentence for several.
    """
    size = len(row["boundary"])
    changes = values_in_words(members, row["boundary"])
    if pd.notna(row["runs"]):
        fails = np.arange(row["runs"]) < row["failing_runs"]
        return words.WITH_REPEATS(
            number=number_of(size, "change"),
            fails=runs_in_words(fails),
            changes=changes,
        )
    return templates[size > 1](
        unsafe=unsafe.event,
        number=_count(size),
        changes=changes,
        share=percentage(share),
    )


def _of_size(at_ends: Enumeration, unsafe: Unsafe, size: int) -> Sentence:
    """Say how many combinations of `size` changes are unsafe."""
    number = sum(len(cause.changes) == size for cause in at_ends.causes)
    existing = at_ends.existing[size]
    simulated = at_ends.simulated[size]
    if simulated == 1:
        is_safe = "is unsafe" if number else "is safe"
        return words.ONLY(
            changes=number_of(size, "change"),
            is_safe=is_safe,
        )
    template = words.OF_SIZE if simulated == existing else words.OF_PART
    combinations = f"combinations of {_count(size)} changes"
    if size == 1:
        combinations = "changes of a single characteristic to an end of its domain"
    return template(
        count=count_in_words(number, simulated),
        combinations=combinations,
        causes=unsafe.effects[number > 1],
        existing=existing,
    )


def _steps(
    steps: Sequence[Enumeration], unsafe: Unsafe, *, has_repeats: bool
) -> Sentences:
    """Say how many changes are needed at each share of the way to the ends. Successive shares with
    equal results share a sentence.
    """
    by_size = groupby(steps, lambda step: (step.size, max(step.simulated)))
    for (size, largest), group in by_size:
        alike = list(group)
        ends = dict.fromkeys(f"{100 * alike[place].share:.0f}" for place in (-1, 0))
        shares = " to ".join(ends)
        if size and has_repeats:
            changes = number_of(size, "change")
            yield words.STEP_WITH_REPEATS(changes=changes, shares=shares)
            continue
        if size:
            changes = "1 change is" if size == 1 else f"{_count(size)} changes are"
            yield words.STEP(
                shares=shares,
                changes=changes,
                unsafe=unsafe.event,
            )
            continue
        yield words.STEP_WITHOUT(
            shares=shares,
            tried=sum(step.tried for step in alike),
            changes=_size_in_words(largest),
            causes=unsafe.effects[0],
        )
        if alike[0].is_cut:
            yield words.LARGER_LEFT_OUT


def _containing(smallest: Smallest) -> Sentences:
    """Say how many combinations contain a smaller cause, and how many of these are safe."""
    total, simulated, cures = smallest.containing
    if total:
        yield words.CONTAINING(combinations=number_of(total, "combination"))
    if simulated:
        yield words.CURES(count=count_in_words(cures, simulated))


def _in_none(smallest: Smallest, members: CharacteristicSet) -> Sentences:
    """Say which characteristics are in no known cause, up to the number of changes up to which all
    combinations of ends were simulated.
    """
    size = smallest.at_ends.complete_up_to
    changed = smallest.changed
    names = [item.short_name for item in members.vehicle if item.name not in changed]
    if names and changed and size:
        yield words.IN_NONE(
            changes=_size_in_words(size),
            names=join_phrases(names, "or"),
        )


def failure_sentences(
    evaluator: Evaluator, population: Population, causes: pd.DataFrame, analysed: int
) -> Sentences:
    """Yield the sentences on the causes of failures in results: which changes are enough, and how
    sure the leading cause is.

    Parameters
    ----------
    causes
        The table of causes, the leading cause first.
    analysed
        Number of analysed failures.
    """
    unsafe = population.unsafe
    original = population.original
    if not evaluator.study.ranges and unsafe.of(original)[0]:
        yield ALREADY_UNSAFE(breach=unsafe.breach_in_words(original))
        yield answer(unsafe.smaller_demand(original))
        return
    if causes.empty and unsafe.number(population.evaluations):
        yield words.NOT_CONFIRMED if evaluator.has_repeats else words.TOO_FEW
        return
    if causes.empty:
        contact = evaluator.system.contact
        ending = ending_in_words(original.outcome[0], original.f_safe[0], contact)
        yield words.NONE_UNSAFE
        yield words.ENDING(ending=ending)
        return
    leading = causes.to_dict("records")[0]
    if not leading["changes"]:
        yield words.UNSAFE_IN_ENCOUNTER
        return

    members = evaluator.characteristics
    yield _enough(words.CHANGES, members, unsafe, leading)
    place = leading.get("encounter", {})
    if values := place_in_words(members, place, are_printed=True):
        yield words.ENCOUNTER(values=values)
    if analysed > 1 and pd.notna(leading["share"]):
        number = round(leading["share"] * analysed)
        yield words.SHARE(
            count=count_in_words(number, analysed),
            have="has" if number <= 1 else "have",
        )
    yield from _beyond(evaluator, unsafe, leading["boundary"], place)
    yield from _sureness(leading)


def _beyond(
    evaluator: Evaluator, unsafe: Unsafe, cause: NamedValues, encounter: NamedValues
) -> Sentences:
    """Say how many vehicles with larger changes than those of a cause are unsafe. All other values
    are as in the original. There is no sentence if no change can be larger, or if too few vehicles
    may be simulated.
    """
    members = evaluator.characteristics
    number = evaluator.of_stage(BEYOND, 4)
    at_cause = members.setting(cause | encounter, beyond=True)
    ends = np.where(at_cause > members.original, members.upper, members.lower)
    is_open = np.isin(members.names, list(cause)) & (ends != at_cause)
    if number < LEAST_NEIGHBOURS or not is_open.any():
        return
    shares = np.random.default_rng(evaluator.seed).random((number, len(members)))
    vehicles = at_cause + np.where(is_open, shares * (ends - at_cause), 0)
    runs = evaluator.evaluate(vehicles, "check vehicles beyond the cause")
    failures = unsafe.number(runs)
    larger = "larger changes of the same characteristics"
    if len(cause) == 1:
        larger = "a larger change of the same characteristic"
    yield words.BEYOND(
        count=count_in_words(failures, number),
        larger=larger,
        collide=unsafe.verbs[failures > 1],
    )


def _sureness(row: Mapping[Any, Any]) -> Sentences:
    """Say how robust the cause in a row of the table is, and in how many parameter sets it is a
    cause, as far as this is known.
    """
    share = row["robust_share"]
    if not np.isnan(share):
        template = words.ROBUST if share >= MIN_ROBUST_SHARE else words.BORDERLINE
        yield template(share="all" if share == 1 else f"{100 * share:.0f} % of")
    if pd.notna(row["holds"]):
        yield words.SETS(
            holds=row["holds"],
            fits=row["fits"],
        )


def other_sentences(
    study: Study, population: Population, complete: int | None, verdicts: pd.DataFrame
) -> Sentences:
    """Yield the sentences below the causes: up to which number of changes the causes are complete,
    who would have avoided the failures, how many vehicles fail, and what counts. `verdicts` are
    those of `assess_sample`.
    """
    unsafe = population.unsafe
    if complete:
        yield words.COMPLETE(changes=number_of(complete, "change"))
    yield from avoidance(verdicts)
    number = unsafe.number(population.evaluations)
    over_sets = population.over_sets
    template = words.NUMBER_OF_SAMPLE if over_sets else words.NUMBER_OF_SOLUTIONS
    yield template(
        count=count_in_words(number, len(population.evaluations)),
        sampled=sampled_in_words(study),
        collide=unsafe.verbs[number > 1],
    )
    texts = constraints_in_words(study)
    if over_sets:
        yield from over_sets.sentences()
        texts += counted_in_words(study, population.omissions)
    yield from notes_on(unsafe, *texts)


def avoidance(verdicts: pd.DataFrame) -> Sentences:
    """Say how many collisions a competent driver, and full braking, would have avoided. Only the
    collisions count on which the driver has a verdict.
    """
    for name, template in AVOIDING.items():
        number = verdicts[name].count()
        collisions = f"{number:,} examined collisions"
        if number < len(verdicts):
            collisions = f"{number:,} collisions with a verdict ({len(verdicts):,} were examined)"
        if number:
            yield template(
                avoided=int(verdicts[name].sum()),
                collisions=collisions,
            )


def _count(number: int) -> str:
    """A number as a word up to ten, and with digits above."""
    return NUMBERS[number] if number < len(NUMBERS) else f"{number:,}"


def _size_in_words(size: int) -> str:
    return "one change" if size <= 1 else f"up to {_count(size)} changes"
