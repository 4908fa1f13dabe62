"""The paragraph for a manager about a study's failures, with which `explain` and the summary of `study` begin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.explain.robustness import Robustness
from safevar_sumo.analysis.preventability import Preventability
from safevar_sumo.analysis.words import OUTCOME_VERBS
from safevar_sumo.records import KMH_PER_MS, Evaluations, Outcome
from safevar_sumo.scenarios import distance_in_words, equals_clear, weather_in_words
from safevar_sumo.scenarios.base import pre_crash_of
from safevar_sumo.sumo.system import System
from safevar_sumo.vehicles import CharacteristicSet

NUMBER_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
MAX_CHANGES_LISTED = 4
"""Maximum number of changes that are listed, the largest first."""


class FailureDescription(NamedTuple):
    """A failure as the paragraph describes it.

    Attributes
    ----------
    name
        Name of the failure, such as a solution's handle.
    changes
        All of the failure's changes, values by name in their units.
    outcome, safety_degree
        Outcome and safety degree [m, or -m/s] of the failure.
    robustness
        Robustness of the failure.
    sufficient_count
        Number of changes that are enough: the size of the failure's minimal causes.
    cause_robustness
        Robustness of the failure's most robust minimal cause by itself; None if not all of its causes were simulated.
    """

    name: str
    changes: Mapping[str, float]
    outcome: str
    safety_degree: float | None
    robustness: Robustness
    sufficient_count: int
    cause_robustness: Robustness | None = None


def failures_paragraph(system: System, original: Evaluations, smallest: FailureDescription | None, robust: FailureDescription | None,
                       preventable: Preventability) -> str:
    """The paragraph about a study's failures.

    Parameters
    ----------
    system
        The study's system; in a test matrix, with the points of the evaluations only.
    original
        The original vehicle's evaluation.
    smallest
        The most severe of the failures with the fewest changes; None if nothing is unsafe.
    robust
        The robust failure with the fewest changes, and among these the smallest largest change; None if no tried failure is robust. It
        leads the paragraph if it has as few changes as `smallest`.
    preventable
        Shares of the collisions among the solutions that reference drivers avoid.
    """
    parts = [f"{_conditions_in_words(system)} the original vehicle {_original_ending_in_words(system, original)}."]
    if smallest is None:
        return " ".join([*parts, "Nothing unsafe was found."])
    characteristics = CharacteristicSet(system.characteristics.members)
    if not smallest.sufficient_count:
        return " ".join([*parts, "No change is needed for it to be unsafe."])
    if robust is not None and len(robust.changes) == len(smallest.changes):
        smallest = robust
    sentence = _failure_in_words(characteristics, smallest)
    parts.append(f"{sentence[0].upper()}{sentence[1:]}")
    if smallest.robustness.borderline:
        parts.append("No failure tested is robust." if robust is None else
                     f"The robust failure with the fewest changes: {_failure_in_words(characteristics, robust)}")
    return " ".join([*parts, str(preventable)]).rstrip()


def _conditions_in_words(system: System) -> str:
    points = system.points
    if len(points) > 1:
        return f"At the worst of {len(points)} test points"
    if system.matrix:
        return f"At {points[0].name},"
    weather = points[0].weather
    return f"{weather_in_words(weather)}{' (which changes neither road nor sensors)' if equals_clear(weather) else ''},"


def _original_ending_in_words(system: System, original: Evaluations) -> str:
    """How the original vehicle's run ends."""
    degree, outcome = float(original.f_safe[0]), Outcome(str(original.outcome[0]))
    if outcome == Outcome.COLLISION:
        return f"itself collides, at {_speed_in_words(degree)}"
    is_pedestrian = all(pre_crash_of(point.scenario).startswith("pedestrian") for point in system.points)
    if outcome == Outcome.STOPPED and is_pedestrian:
        return f"stops {degree:.2f} m short of the pedestrian"
    return f"{OUTCOME_VERBS.get(outcome, outcome)}" + (
        "" if np.isnan(degree) else f" with a safety degree of {distance_in_words(system.points[0].scenario, degree)}")


def _failure_in_words(characteristics: CharacteristicSet, failure: FailureDescription) -> str:
    """A sentence such as `a collision at 1.5 m/s, 5 km/h (rs:0:4, robust: ...) was found with ten changes: ...; three of them suffice`."""
    number, sufficient = len(failure.changes), failure.sufficient_count
    effect = f"{_outcome_in_words(failure)} ({failure.name}, {failure.robustness})"
    listed = _changes_in_words(characteristics, failure.changes)
    if sufficient < number:
        cause = "" if failure.cause_robustness is None else f" ({failure.cause_robustness})"
        subset = f"{_count_in_words(sufficient)} of them {_verb_suffice(sufficient)}{cause}"
        return f"{effect} was found with {_count_in_words(number)} changes: {listed}; {subset}."
    return f"{_count_in_words(number)} {'change' if number == 1 else 'changes'} {_verb_suffice(number)} for {effect}: {listed}."


def _verb_suffice(number: int) -> str:
    return "suffices" if number == 1 else "suffice"


def _count_in_words(number: int) -> str:
    return NUMBER_WORDS[number] if number < len(NUMBER_WORDS) else str(number)


def _outcome_in_words(failure: FailureDescription) -> str:
    if failure.safety_degree is None:
        return failure.outcome
    if failure.outcome == Outcome.COLLISION:
        return f"a collision at {_speed_in_words(failure.safety_degree)}"
    return f"a safety degree of only {failure.safety_degree:.2f} m"


def _speed_in_words(degree: float) -> str:
    """The collision speed of a safety degree in m/s, and in whole km/h or, below 3 km/h, with a decimal."""
    speed = -degree * KMH_PER_MS
    return f"{-degree:.1f} m/s, {speed:.{int(speed < 3)}f} km/h"


def _changes_in_words(characteristics: CharacteristicSet, values: Mapping[str, float]) -> str:
    """Short names with changes relative to the original values, the largest change first."""
    shares = [((values[characteristic.name] - characteristic.original) / abs(characteristic.original), characteristic.short_name)
              for characteristic in characteristics if characteristic.name in values]
    largest = sorted(shares, key=lambda share_and_name: -abs(share_and_name[0]))
    parts = [f"{name} {100 * share:+.0f} %" for share, name in largest[:MAX_CHANGES_LISTED]]
    return ", ".join(parts) + (f" and {len(shares) - MAX_CHANGES_LISTED} more" if len(shares) > MAX_CHANGES_LISTED else "")
