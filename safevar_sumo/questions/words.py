"""Words that commands, figures and reports share: outcomes, changes, numbers, commands."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from shlex import quote

from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.records import Outcome
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

OUTCOME_VERBS = {
    Outcome.STOPPED: "stops",
    Outcome.PASSED: "passes",
    Outcome.TIMEOUT: "is still under way at the end",
    Outcome.NEVER_MOVED: "never moves",
    Outcome.SIMULATOR_ERROR: "could not be simulated",
    Outcome.INVALID_TEST: "ends as an invalid test",
    Outcome.INFEASIBLE: "violates a constraint",
}
"""How a run ended, as the verb of a sentence; a collision is described with its speed instead."""


EXACT = ".15g"
"""How values are printed with which a vehicle was simulated: all their digits."""
LOST_SHARE = 0.05
"""A value is printed with all its digits where rounding would change more of it."""


def ending_in_words(outcome: str, safety_degree: float | None, contact: float) -> str:
    """How a run ended, such as `collides at 3.21 m/s` or `stops with a safety degree of 0.87 m`.

    The safety degree is in m, or -m/s on a collision; bodies touch at a safety degree of `contact`.
    """
    verb = (
        "collides"
        if outcome == Outcome.COLLISION
        else OUTCOME_VERBS.get(Outcome(outcome), outcome)
    )
    if safety_degree is None or math.isnan(safety_degree):
        return verb
    if outcome == Outcome.COLLISION:
        return f"{verb} at {abs(safety_degree):.2f} m/s"
    return f"{verb} with a safety degree of {distance_in_words(safety_degree, contact)}"


def collision_in_words(closing_speed: float, own_speed: float, digits: int = 2) -> str:
    """How a vehicle collides [m/s], such as `collides at 3.17 m/s`; with its own speed if that is
    another one, as the struck body moves along the lane.
    """
    closing, own = (f"{speed:.{digits}f}" for speed in (closing_speed, own_speed))
    beside = "" if closing == own else f" (closing speed; its own is {own} m/s)"
    return f"collides at {closing} m/s{beside}"


def change_texts(
    characteristics: CharacteristicSet,
    values: Mapping[str, float],
    *,
    are_printed: bool = False,
) -> list[str]:
    """The values that differ from the original values, in the order of the study, such as `mass
    2404 -> 2600 kg (+8.2 %)`, without a share of an original that is 0. Values that `are_printed`
    have their digits already.
    """
    texts = []
    for item in characteristics:
        original = item.original
        value = values.get(item.name, item.original)
        if value != original:
            share = (
                f" ({100 * (value - original) / abs(original):+.1f} %)"
                if original
                else ""
            )
            rounded = item.text(value)
            # Over many decades, or next to the original, its decimals would tell another value.
            error = abs(float(rounded) - value)
            is_lost = float(rounded) == original or error > LOST_SHARE * abs(value)
            text = f"{value:{EXACT}}" if are_printed or is_lost else rounded
            texts.append(f"{item.name} {original:g} -> {text}{item.suffix}{share}")
    return texts


def undecidable_in_words(items: Iterable[Characteristic]) -> str:
    """That limits of characteristics are too near to the original, in a sentence."""
    return (
        f"Not decidable in a workshop, as the limit is nearer to the original vehicle than it is"
        f" measured: {precise_in_words(items)}."
    )


def precise_in_words(items: Iterable[Characteristic]) -> str:
    """The characteristics among some of which the study states how precisely they are measured; ""
    for none.
    """
    phrases = [
        f"{item.short_name} (measured to within {item.error:g}{item.suffix})"
        for item in items
        if item.error
    ]
    return join_phrases(phrases) if phrases else ""


def encounter_in_words(
    characteristics: CharacteristicSet,
    values: Mapping[str, float],
    *,
    are_printed: bool = False,
) -> str:
    """The searched parameters of the scenario, such as ` in an encounter with speed 59.5 km/h`;
    empty without any.
    """
    texts = {
        item: f"{values[item.name]:{EXACT}}"
        if are_printed
        else item.text(values[item.name])
        for item in characteristics.scenario
    }
    phrases = [f"{item.short_name} {text}{item.suffix}" for item, text in texts.items()]
    return f" in an encounter with {join_phrases(phrases)}" if phrases else ""


def replay_command(subject: str, point: str = "") -> str:
    """The command that simulates a vehicle of results or a study; `point` may name a point of the
    study's matrix.
    """
    where = f" --point {quote(point)}" if point else ""
    return f"{PROGRAM_COMMAND} simulate {quote(subject)}{where}"


def join_phrases(phrases: Iterable[str]) -> str:
    """Phrases of a sentence as a list: `a, b and c`."""
    *beginning, last = phrases
    return f"{', '.join(beginning)} and {last}" if beginning else last


def number_of(count: int, noun: str) -> str:
    """A number with its noun: `1 change`, `2,000 changes`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


MAX_POINTS_NAMED = 6
"""Maximum number of failing test cases that a sentence names."""


def points_in_words(
    vehicle: str, failing_points: Sequence[str], point_count: int
) -> str:
    """A sentence such as `The original vehicle fails 2 of 72 test cases: CPNA, speed 40,
    impact_location 25; CPLA, speed 60, clear.`
    """
    if not failing_points:
        tests = (
            f"none of the {point_count} test cases"
            if point_count > 1
            else "no test case"
        )
        return f"{vehicle} fails {tests}."
    rest = len(failing_points) - MAX_POINTS_NAMED
    names = "; ".join(failing_points[:MAX_POINTS_NAMED]) + (
        f" and {rest} more" if rest > 0 else ""
    )
    return (
        f"{vehicle} fails {len(failing_points)} of {point_count} test cases: {names}."
    )


def share_in_words(share: float) -> str:
    """A share in whole per cent, such as `14 %`; `all` and `none` only if it is exactly that."""
    if share in (0, 1):
        return "all" if share else "none"
    if share >= 0.995:
        return "nearly all"
    return "hardly any" if share < 0.005 else f"{100 * share:.0f} %"


def percentage(share: float) -> str:
    """A share as a percentage with the digits that decide, without its sign: `37`, `0.043`."""
    value = 100 * share
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"


def bound_in_words(at_most: float) -> str:
    """The upper bound of a share, which is one-sided."""
    return f"with {100 * CONFIDENCE:g} % confidence at most {100 * at_most:.3g} %"


def two_decimals(value: float | None) -> str:
    """A value with two decimals, never `-0.00`; `-` if undefined."""
    return (
        "-" if value is None or math.isnan(value) else f"{round(value, 2) + 0.0:.2f}"
    )  # -0.0 + 0.0 is 0.0


def counted_in_words(study: Study, left_out: int | None = None) -> list[str]:
    """What a vehicle of a study whose encounters are ranges meets, and how many encounters do not
    count, in a sentence; empty for any other study.
    """
    if not study.ranges:
        return []
    names = join_phrases(study.ranges)
    own = f"Each vehicle drives in its own encounter ({names})."
    left = [] if left_out is None else [f"{number_of(left_out, 'encounter')} left out."]
    return [own, *demanded_in_words(study), *left]


def with_scope(study: Study, left_out: int, *sentences: str) -> str:
    """Sentences of a verdict on sampled vehicles, and which vehicles and encounters count."""
    scope = [*counted_in_words(study, left_out), *constraints_in_words(study)]
    return " ".join(filter(None, [*sentences, *scope]))


def demanded_in_words(study: Study) -> list[str]:
    """What the original vehicle must keep in a searched encounter, in a sentence; empty for any
    other study.
    """
    margin = f"at least {study.scenario.margin or 0:g} m of clearance (scenario.margin)"
    sentence = f"Only encounters count in which the original vehicle keeps {margin}."
    return [sentence] if study.ranges else []


def constraints_in_words(study: Study) -> list[str]:
    """The constraints that all settings satisfy, in a sentence; empty if the study has none."""
    characteristics = study.vehicle.characteristics
    conditions = "; ".join(
        f"{constraint.quantity} {constraint.bounds_in_words(characteristics)}"
        for constraint in study.shared_constraints
    )
    return (
        [f"Only vehicles that satisfy the study's constraints count: {conditions}."]
        if conditions
        else []
    )
