"""Phrases that commands, figures and reports share: outcomes, changes, numbers and commands."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from shlex import quote

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.questions.sentence import Sentence, answer, condition, note
from safevar_sumo.records import NamedValues, Outcome
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

OUTCOME_VERBS = {
    Outcome.STOPPED: "stops",
    Outcome.PASSED: "passes",
    Outcome.TIMEOUT: "is still driving when the simulation ends",
    Outcome.NEVER_MOVED: "never moves",
    Outcome.SIMULATOR_ERROR: "could not be simulated",
    Outcome.INVALID_TEST: "drives an invalid test, which counts neither as failure nor as success",
    Outcome.INFEASIBLE: "violates a constraint of the study",
}
"""How a run ended, as the verb of a sentence. A collision is described with its speed instead."""


ALREADY_UNSAFE = answer(
    "The original vehicle is already unsafe: it {breach}. A failure needs no change of the"
    " vehicle."
)
OWN_SET_ALONE = condition(
    "Only the study's own parameter set (calibration) of the vehicle model was driven, and no other"
    " set of the study."
)
SINGLE_SET = condition(
    "A single parameter set (calibration) of the vehicle model was driven, because the study has no"
    " others."
)
VALID_FOR = note("Valid for: {scope}.")
UNSAFE_MEANS = note("Unsafe means: {description}.")
EXACT = ".15g"
"""Format that prints a value with all its digits, so that a reader can simulate it again."""
LOST_SHARE = 0.05
"""A value is printed with all its digits if rounding would change it by more than this share."""


def ending_in_words(outcome: str, safety_degree: float, contact: float) -> str:
    """How a run ended, such as `collides at 3.21 m/s` or `stops, with a safety degree (smallest
    distance) of 0.87 m`.

    The safety degree is in m, or -m/s on a collision; bodies touch at a safety degree of `contact`.
    """
    if outcome == Outcome.COLLISION:
        return f"collides at {abs(safety_degree):.2f} m/s"
    verb = OUTCOME_VERBS[Outcome(outcome)]
    if math.isnan(safety_degree):
        return verb
    distance = distance_in_words(safety_degree, contact)
    return f"{verb}, with a safety degree (smallest distance) of {distance}"


def collision_in_words(closing_speed: float, own_speed: float, digits: int = 2) -> str:
    """How a vehicle collides, such as `collides at 3.17 m/s`. The vehicle's own speed is added if
    it differs from the closing speed, because the struck body moves along the lane. Speeds are in
    m/s.
    """
    closing, driven = (f"{speed:.{digits}f}" for speed in (closing_speed, own_speed))
    if closing == driven:
        return f"collides at {closing} m/s"
    return f"collides at a closing speed of {closing} m/s (own speed {driven} m/s)"


def change_texts(
    characteristics: CharacteristicSet,
    values: NamedValues,
    *,
    are_printed: bool = False,
) -> list[str]:
    """The changed values of a vehicle, in the order of the study, such as `mass from 2404 to 2600
    kg (+8.2 %)`. The percentage is left out if the original value is 0. With `are_printed` the
    values are rounded already, and all their digits are printed.
    """
    texts = []
    for item in characteristics:
        original = item.original
        value = values.get(item.name, item.original)
        if value != original:
            share = ""
            if original:
                share = f" ({100 * (value - original) / abs(original):+.1f} %)"
            rounded = item.text(value)
            # A value that is close to 0 in a wide domain, or close to the original, would look like
            # another value with the usual decimals.
            error = abs(float(rounded) - value)
            is_lost = float(rounded) == original or error > LOST_SHARE * abs(value)
            text = f"{value:{EXACT}}" if are_printed or is_lost else rounded
            texts.append(
                f"{item.short_name} from {original:g} to {text}{item.suffix}{share}"
            )
    return texts


def undecidable_in_words(items: Sequence[Characteristic]) -> str:
    """Sentences that say that a workshop cannot check limits of characteristics, because they are
    too near to the original values, and what to do.
    """
    sentences = [
        f"A workshop cannot check the limit of {item.short_name}: the allowed change is smaller"
        f" than the measuring error ({item.error:g}{item.suffix})."
        for item in items
    ]
    names = join_phrases(item.short_name for item in items)
    sentences.append(
        f"Ask the manufacturer's service to measure {names}, or treat each such part as one that"
        " must be as new."
    )
    return " ".join(sentences)


def precise_in_words(items: Iterable[Characteristic]) -> str:
    """The characteristics for which the study states a measuring error, with this error, as a
    phrase; "" if there are none.
    """
    return join_phrases(
        f"{item.short_name} (measured to within {item.error:g}{item.suffix})"
        for item in items
        if item.error
    )


def place_in_words(
    characteristics: CharacteristicSet,
    values: NamedValues,
    *,
    are_printed: bool,
) -> str:
    """The searched parameters of the scenario, such as `speed 59.5 km/h`; "" without any."""
    phrases = []
    for item in characteristics.scenario:
        value = values[item.name]
        text = f"{value:{EXACT}}" if are_printed else item.text(value)
        phrases.append(f"{item.short_name} {text}{item.suffix}")
    return join_phrases(phrases)


def encounter_in_words(
    characteristics: CharacteristicSet,
    values: NamedValues,
    *,
    are_printed: bool = False,
) -> str:
    """The end of a sentence that states the encounter, such as ` in an encounter with speed 59.5
    km/h`; "" without searched parameters.
    """
    place = place_in_words(characteristics, values, are_printed=are_printed)
    return f" in an encounter with {place}" if place else ""


def replay_command(subject: str, point: str = "") -> str:
    """The command that simulates a vehicle of results or a study; `point` may name a point of the
    study's matrix.
    """
    where = f" --point {quote(point)}" if point else ""
    return f"{PROGRAM_COMMAND} simulate {quote(subject)}{where}"


def join_phrases(phrases: Iterable[str], conjunction: str = "and") -> str:
    """Phrases of a sentence as a list: `a, b and c`; empty without any."""
    *beginning, ending = list(phrases) or [""]
    return f"{', '.join(beginning)} {conjunction} {ending}" if beginning else ending


def join_few(phrases: Sequence[str], most: int, others: str = "more") -> str:
    """At most `most` phrases as a list, and the number of all others: `a, b and 3 more`."""
    surplus = len(phrases) - most
    if surplus > 0:
        phrases = [*phrases[:most], f"{surplus} {others}"]
    return join_phrases(phrases)


def count_in_words(count: float, total: int) -> str:
    """A count with its total: `none of the 24`, `1 of the 24`, `all 24`."""
    if count == total > 1:
        return f"all {total:,}"
    number = f"{count:,.1f}".removesuffix(".0") if count else "none"
    return f"{number} of the {total:,}"


def number_of(count: int, noun: str) -> str:
    """A number with its noun: `1 change`, `2,000 changes`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


MAX_POINTS_NAMED = 6
"""Maximum number of failing test cases that a sentence names."""


def points_in_words(
    vehicle: str, failing_points: Sequence[str], point_count: int
) -> str:
    """A sentence such as `The original vehicle fails in 2 of 72 test cases: CPNA, speed 40,
    impact_location 25; CPLA, speed 60, clear.`
    """
    number = len(failing_points)
    if not number:
        tests = "no test case"
        if point_count > 1:
            tests = f"none of the {point_count} test cases"
        return f"{vehicle} fails in {tests}."
    names = "; ".join(failing_points[:MAX_POINTS_NAMED])
    if number > MAX_POINTS_NAMED:
        names += f" and {number - MAX_POINTS_NAMED} more"
    return f"{vehicle} fails in {number} of {point_count} test cases: {names}."


def percentage(share: float) -> str:
    """A share as a percentage without the percent sign: `37`, `0.043`. It has two significant
    digits, and no decimals from 10 on.
    """
    value = 100 * share
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"


def interval_in_words(low: float, high: float) -> str:
    """The interval of a share, such as `0.25 to 0.5 %`."""
    return f"{percentage(low)} to {percentage(high)} %"


def bound_in_words(at_most: float) -> str:
    """The one-sided upper bound of a share, with its confidence, as a phrase."""
    return f"with {100 * CONFIDENCE:g} % confidence at most {100 * at_most:.3g} %"


def two_decimals(value: float | None) -> str:
    """A value with two decimals, never `-0.00`; `-` if undefined."""
    if value is None or math.isnan(value):
        return "-"
    # Adding 0.0 turns -0.0 into 0.0.
    return f"{round(value, 2) + 0.0:.2f}"


def counted_in_words(study: Study, omissions: int | None = None) -> list[str]:
    """Sentences on a study whose encounters are ranges: which encounters vehicles meet, which
    encounters count, and how many were left out. Any other study has none.
    """
    if not study.ranges:
        return []
    axes = join_phrases(study.ranges)
    sentences = [
        f"Each vehicle meets an encounter of its own, with its own values of {axes}.",
        *demanded_in_words(study),
    ]
    if omissions:
        sentences.append(f"{omissions:,} encounters do not count and were left out.")
    return sentences


def notes_on(unsafe: Unsafe, *texts: str) -> list[Sentence]:
    """Notes with the given texts and the criterion's remark. A last note says what unsafe means, if
    that is not only a collision.
    """
    notes = list(map(note, (*texts, unsafe.remark)))
    if not unsafe.is_collision:
        notes.append(UNSAFE_MEANS(description=unsafe.description))
    return notes


def demanded_in_words(study: Study) -> list[str]:
    """A sentence on the clearance that the original vehicle must keep, so that an encounter counts;
    empty if the study lists its encounters.
    """
    sentence = (
        "An encounter counts only if the original vehicle keeps at least"
        f" {study.scenario.margin or 0:g} m of clearance in it (scenario.margin)."
    )
    return [sentence] if study.ranges else []


def constraints_in_words(study: Study) -> list[str]:
    """A sentence on the constraints that all settings satisfy; empty without constraints."""
    characteristics = study.vehicle.characteristics
    conditions = "; ".join(
        f"{constraint.quantity} {constraint.bounds_in_words(characteristics)}"
        for constraint in study.shared_constraints
    )
    sentence = f"A vehicle counts only if it satisfies the constraints of the study: {conditions}."
    return [sentence] if conditions else []


def single_set_in_words(study: Study, driven: int) -> Sentence:
    """Say that a single parameter set was driven. The sentence is empty if several were, or if the
    study has a simulator of the user's own, which has no parameter sets.
    """
    if driven > 1 or not study.vehicle.model:
        return condition("")
    return OWN_SET_ALONE if study.spread else SINGLE_SET
