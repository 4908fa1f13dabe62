"""The sentences of an answer about cars: templates are chosen, and filled with what was found."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from safevar_sumo.questions.counterexamples import limit_text
from safevar_sumo.questions.permit import words
from safevar_sumo.questions.permit.fleet import THIS_CAR
from safevar_sumo.questions.permit.found import (
    DRIVE,
    LIMITED,
    STOP,
    Found,
    FoundCar,
    WorstEnd,
)
from safevar_sumo.questions.permit.speed_search import STANDING
from safevar_sumo.questions.sentence import Sentence, answer, condition
from safevar_sumo.questions.words import (
    VALID_FOR,
    join_phrases,
    number_of,
    precise_in_words,
)
from safevar_sumo.study import unit_text


def slots_of(found: Found) -> dict[str, str]:
    """The slots that sentences share: the verbs (pass a test, or drive), and the speeds."""
    span = found.span
    return {
        **(words.PASSING if found.is_test else words.DRIVING),
        "name": span.title,
        "low": span.text(span.low),
        "top": span.text(span.high),
        "need": span.text(found.need or 0.0),
    }


def verdict_sentences(found: Found) -> Iterator[Sentence]:
    """The sentences of the verdict: how far cars are safe, why no farther, what is assumed, whether
    all cars reach the speed that is needed, and what "safe" means.
    """
    slots = slots_of(found)
    first = found.cars[0]
    is_single = len(found.cars) == 1
    if is_single:
        yield _of_car(found, first)
    else:
        yield from _of_groups(found)
    yield words.NEW_CAR(reach=_reach(found, found.new_car), **slots)
    if is_single:
        yield answer(reason_of(found, first).text)
    yield from assumed_sentences(found)
    are_ends_told = found.has_worst_ends and not found.fleet.measured.all()
    if is_single and first.permit.safe_value is not None and are_ends_told:
        yield _worst_end(found, first.worst_end)
    if found.need is not None:
        yield too_slow(found)
    yield from _notes(found)
    yield VALID_FOR(scope=found.scope)
    yield _safe(found)


def _of_car(found: Found, car: FoundCar) -> Sentence:
    """Say how far the only car is safe."""
    text = car.name
    if not (found.is_box or text == THIS_CAR):
        text = words.NAMED_CAR.format(name=text)
    safe_value = car.permit.safe_value
    if safe_value is None:
        return words.CAR_STOPS(car=text, **slots_of(found))
    return words.CAR(car=text, reach=_reach(found, safe_value), **slots_of(found))


def _of_groups(found: Found) -> Iterator[Sentence]:
    """Say how many cars have each verdict."""
    templates = {DRIVE: words.FAST, LIMITED: words.SLOWER, STOP: words.STOPPING}
    if found.need is not None:
        templates[DRIVE] = words.FAST_ENOUGH
    cars = number_of(len(found.cars), "car")
    counts = found.counts
    for verdict, template in templates.items():
        if counts[verdict]:
            yield template(count=f"{counts[verdict]} of {cars}", **slots_of(found))


def _reach(found: Found, value: float) -> str:
    """The range in which cars are safe, in words that follow the verb."""
    return found.span.range_text(value, with_low=not found.is_test)


def reason_of(found: Found, car: FoundCar) -> Sentence:
    """Why a car may drive no faster, in a sentence for a foreman."""
    span = found.span
    least = car.permit.least
    failure = least.failure
    slots = {**slots_of(found), "new_car": span.range_text(found.new_car)}
    if least.example is not None:
        slots["event"] = least.example.because
    if least.safe_value is not None:
        slots["reach"] = span.range_text(least.safe_value)
    template = words.AS_NEW
    if failure is None:
        template = words.SAFE_TO_TOP
    elif failure.robustness == STANDING:
        template = words.NEVER_MOVES
    elif np.isneginf(failure.value):
        template = words.IN_FIXED_TEST
    elif least.safe_value is None:
        template = words.NOT_AT_ALL
    elif found.verdict_of(car) != DRIVE:
        template = words.UNSAFE_BEYOND
    elif found.need is not None:
        template = words.NEED_REACHED
    return template(**slots)


def assumed_sentences(found: Found) -> Iterator[Sentence]:
    """Say which values are assumed in all cars, and whether a value is stated by the study or is
    that of the new car. Then say in how many cars further values are assumed.
    """
    fleet = found.fleet
    is_measured = fleet.measured.any(axis=0)
    stated = list[str]()
    as_new = list[str]()
    for column in np.flatnonzero(~is_measured).tolist():
        item = found.vehicle.members[column]
        text = f"{item.short_name} {limit_text(item, fleet.settings[0, column])}"
        if item.name in found.study.unmeasured:
            stated.append(text)
        else:
            as_new.append(text)
    if stated:
        yield words.ASSUMED(values=join_phrases(stated))
    if as_new:
        yield words.ASSUMED_NEW(values=join_phrases(as_new))
    has_further = (~fleet.measured & is_measured).any(axis=1)
    if has_further.any():
        number = np.count_nonzero(has_further)
        yield words.FURTHER_ASSUMED(count=f"{number} of {len(fleet.names)} cars")


def _worst_end(found: Found, end: WorstEnd | None) -> Sentence:
    """Say which assumed value matters most, or that none lowers the speed."""
    slots = slots_of(found)
    if end is None:
        return words.NO_WORST_END(**slots)
    column = found.vehicle.names.index(end.name)
    item = found.vehicle.members[column]
    return words.WORST_END(
        assumption=item.short_name,
        end=end.text,
        assumed=limit_text(item, found.fleet.settings[0, column]),
        value=found.span.text(max(end.value, found.span.low)),
        **slots,
    )


def too_slow(found: Found) -> Sentence:
    """Say how many cars do not reach the speed that the user needs."""
    return words.TOO_SLOW(count=number_of(found.too_slow, "car"), **slots_of(found))


def _notes(found: Found) -> Iterator[Sentence]:
    """Say which values are measured inexactly, whether the list is rough, what holds for phases,
    and which tests end early or were left out.
    """
    span = found.span
    # Limits that a user states are no measurements, so no note on their exactness is needed.
    if not found.is_box:
        is_measured = found.fleet.measured.any(axis=0)
        measured = [
            found.vehicle.members[column]
            for column in np.flatnonzero(is_measured).tolist()
        ]
        if names := precise_in_words(measured):
            yield words.MEASURED(names=names)
    if found.fleet.is_rough:
        yield words.ROUGH_LIST
    yield condition(found.phases)
    if span.ending:
        yield words.ENDING(tests=join_phrases(span.ending), **slots_of(found))
    if span.tests_above:
        yield words.LEFT_OUT(tests=join_phrases(span.tests_above), **slots_of(found))


def _safe(found: Found) -> Sentence:
    """Say what "safe" means, for the study's own parameter set and for the other sets."""
    unsafe = found.unsafe
    template = words.SAFE_WITHOUT_CONTACT
    if unsafe.keep and found.sets > 1:
        template = words.SAFE_WITH_CLEARANCE_IN_OWN_SET
    elif unsafe.keep:
        template = words.SAFE_WITH_CLEARANCE
    elif unsafe.below:
        template = words.SAFE_WITH_DISTANCE
    elif unsafe.below is None and not unsafe.is_collision:
        template = words.SAFE_BY_CRITERION
    return template(
        unsafe=unsafe.description,
        keep=unsafe.keep,
        below=unsafe.below,
        sets=number_of(found.sets, "parameter set"),
        others=number_of(found.sets - 1, "other parameter set"),
        **slots_of(found),
    )


def tested_sentence(found: Found) -> Sentence:
    """Say at which speeds cars were driven, and how many simulations searched for failures."""
    values = found.values
    driven = f"from {values[0]:g} to {found.span.text(values[-1])}"
    if found.is_listed:
        listed = join_phrases(f"{value:g}" for value in values)
        driven = f"({listed}{unit_text(found.span.unit)})"
    template = words.TESTED_QUICK if found.is_quick else words.TESTED
    return template(number=len(values), values=driven, attacked=found.attacked)
