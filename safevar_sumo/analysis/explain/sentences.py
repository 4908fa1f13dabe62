"""The answer of `explain` in sentences, the verdict first: the summary of `study`, `explain` and reports say the
same.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safevar_sumo.analysis.explain.braking_comparison import sentence
from safevar_sumo.analysis.words import OUTCOME_VERBS, list_of_changes, number_of
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.records import KMH_PER_MS, Evaluations, Outcome
from safevar_sumo.scenarios import distance_in_words, equals_clear, weather_in_words
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

if TYPE_CHECKING:
    from safevar_sumo.analysis.explain.result import Explained, Explanation

ROBUST = "smallest robust"
"""The reason for choosing the robust failure with the fewest changes."""
REASONS = {"fewest": "fewest changes", "smallest": "smallest changes", "most_severe": "most severe"}
"""The other reasons for choosing a failure, by the name of the choice in `CHOICES`; the JSON contains these texts."""
DISTINCT_CAUSE = "a cause of its own"
"""The reason for choosing the simplest failure with a cause that no other chosen failure has."""
LABELS = {
    ROBUST: "robust with the fewest changes",
    REASONS["fewest"]: "fewest changes",
    REASONS["smallest"]: "smallest largest change",
    REASONS["most_severe"]: "most severe",
    DISTINCT_CAUSE: "distinct cause",
}
"""Titles of failures by the reason for their choice, in the order in which they are shown."""
NUMBER_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
MAX_CHANGES_LISTED = 4
"""Maximum number of changes that the verdict lists, the largest first."""
MAX_NECESSARY = 4
"""Maximum number of characteristics named as necessary most often."""


def answer_in_words(result: Explained) -> list[str]:
    """The verdict as a paragraph, the counts, and why and by how little the first failure fails."""
    sentences = [result.no_verdict] if result.no_verdict else []
    sentences += [" ".join(verdict_in_words(result)), counts_in_words(result)]
    if not result.explanations:
        return sentences
    first = result.explanations[0]
    sentences.append(f"Why {first.name} fails: {sentence(first.because, full=True)}")
    if first.cause and first.cause.changes:
        sentences.append(f"How little is enough: {_limits_in_words(result, first.cause.boundary)}.")
    if result.analysed and len(result.distinct):
        common = result.distinct.iloc[0]
        sentences += [
            f"In every cause of a failure most often ({result.sample}): {_most_necessary_in_words(result)}.",
            f"{number_of(len(result.distinct), 'distinct minimal cause')}; the most frequent: "
            f"{', '.join(common['cause']) or 'none'} ({100 * common['share']:.0f} % of the failures).",
        ]
    return sentences


def counts_in_words(result: Explained) -> str:
    """The criterion, and how many settings are unsafe by it."""
    unsafe = (
        f"{result.failures} of {number_of(result.looked_at, 'different vehicle')} are unsafe: "
        f"{result.unsafe.description}."
    )
    if not result.otherwise:
        return unsafe
    return (
        f"{unsafe} {number_of(result.otherwise, 'setting')} with another outcome than recorded: has the version "
        "or the code changed?"
    )


def verdict_in_words(result: Explained) -> list[str]:
    """The verdict in sentences: the situation, the failure to lead with, the robust one, and who would have avoided the
    collisions.

    The failure to lead with has the fewest changes; of several the robust one, else the most severe.
    """
    system, reasons = assemble(result.study), result.by_reason
    parts = [situation_in_words(system, result.original, result.nearest, result.looked_at)]
    robust, first = reasons.get(ROBUST), reasons.get(REASONS["fewest"], next(iter(result.explanations), None))
    if first is None or first.cause is None:
        return parts if result.no_verdict else [*parts, "Nothing unsafe was found."]
    if not first.cause.changes:
        return [*parts, "No change is needed for it to be unsafe."]
    if robust is not None and len(robust.changed) == len(first.changed):
        first = robust
    parts.append(finding_in_words(system.characteristics, first))
    if first.robustness.borderline:
        parts.append(
            "No failure tested is robust."
            if robust is None
            else f"The robust failure with the fewest changes: {finding_in_words(system.characteristics, robust)}"
        )
    return [part[0].upper() + part[1:] for part in [*parts, str(result.preventability)] if part]


def situation_in_words(
    system: System, original: Evaluations, nearest: Evaluations | None = None, number: int = 0
) -> str:
    """The conditions and how the original vehicle's run ends; first that nothing collides, if so of `number` vehicles.

    `nearest` is the evaluation of the least safe of these vehicles.
    """
    points, weather = system.points, system.points[0].weather
    where = (
        f"at the worst of {len(points)} test points"
        if len(points) > 1
        else f"at {points[0].name}"
        if system.matrix
        else (
            f"{weather_in_words(weather)}{' (which changes neither road nor sensors)' if equals_clear(weather) else ''}"
        )
    )
    own_ending = _ending_in_words(system, original)
    if (
        nearest is None
        or not len(nearest)
        or nearest.collided[0]
        or original.collided[0]
        or RATING_POINTS.name in original.metrics
    ):
        return f"{where[0].upper()}{where[1:]}, the original vehicle {own_ending}."
    other = f"{original.f_safe[0]:.2f} m" if nearest.outcome[0] == original.outcome[0] else own_ending
    ending = _ending_in_words(system, nearest)
    return (
        f"No collision in {number_of(number, 'vehicle')}; the worst {ending}, the original {other}, "
        f"{where[0].lower()}{where[1:]}."
    )


def _ending_in_words(system: System, run: Evaluations) -> str:
    """How the only run of an evaluation ends."""
    degree, outcome = float(run.f_safe[0]), Outcome(str(run.outcome[0]))
    if RATING_POINTS.name in run.metrics:
        return f"earns {run.metrics[RATING_POINTS.name][0]:.2f} points"
    if outcome == Outcome.COLLISION:
        return f"itself collides, at {_speed_in_words(degree)}"
    if outcome == Outcome.STOPPED and all(point.scenario.pre_crash.startswith("pedestrian") for point in system.points):
        return f"stops {degree:.2f} m short of the pedestrian"
    distance = (
        "" if np.isnan(degree) else f" with a safety degree of {distance_in_words(system.points[0].scenario, degree)}"
    )
    return f"{OUTCOME_VERBS.get(outcome, outcome)}{distance}"


def finding_in_words(characteristics: CharacteristicSet, failure: Explanation) -> str:
    """A sentence such as `a collision at 1.5 m/s, 5 km/h (rs:0:4, robust: ...) was found with ten changes: ...; three
    of them suffice`.
    """
    number, cause = len(failure.changed), failure.cause
    effect = f"{effect_in_words(failure)} ({failure.name}, {failure.robustness})"
    shares = [
        (_share_of_change(failure, item), item.short_name) for item in characteristics if item.name in failure.changed
    ]
    largest = sorted(shares, key=lambda share: -abs(share[0]))
    changes = ", ".join(f"{name} {100 * share:+.0f} %" for share, name in largest[:MAX_CHANGES_LISTED])
    changes += f" and {number - MAX_CHANGES_LISTED} more" if number > MAX_CHANGES_LISTED else ""
    if cause is None or len(cause.changes) == number:
        return (
            f"{_count_in_words(number)} {'change suffices' if number == 1 else 'changes suffice'} for {effect}: "
            f"{changes}."
        )
    robustness = "" if cause.neighbours is None else f" ({cause.neighbours})"
    needed = (
        f"{_count_in_words(len(cause.changes))} of them "
        f"{'suffices' if len(cause.changes) == 1 else 'suffice'}{robustness}"
    )
    return f"{effect} was found with {_count_in_words(number)} changes: {changes}; {needed}."


def _share_of_change(failure: Explanation, characteristic: Characteristic) -> float:
    return (failure.setting[characteristic.name] - characteristic.original) / abs(characteristic.original)


def _count_in_words(number: int) -> str:
    return NUMBER_WORDS[number] if number < len(NUMBER_WORDS) else str(number)


def effect_in_words(failure: Explanation) -> str:
    if failure.safety_degree is None:
        return failure.outcome
    if failure.outcome == Outcome.COLLISION:
        return f"a collision at {_speed_in_words(failure.safety_degree)}"
    return f"a safety degree of only {failure.safety_degree:.2f} m"


def _speed_in_words(degree: float) -> str:
    """The collision speed of a safety degree in m/s, and in whole km/h or, below 3 km/h, with a decimal."""
    speed = -degree * KMH_PER_MS
    return f"{-degree:.1f} m/s, {speed:.{int(speed < 3)}f} km/h"


def choices_in_words(result: Explained) -> list[str]:
    """A sentence for each failure that was chosen by its size or severity: its size, and the cause that is named."""
    characteristics = CharacteristicSet.of(result.study.vehicle.characteristics)
    sentences = []
    for failure in result.choices:
        largest = max((abs(_share_of_change(failure, item)) for item in characteristics), default=0.0)
        size = f"{number_of(len(failure.changed), 'change')} of up to {100 * largest:.0f} %"
        others = number_of(len(failure.causes) - 1, "alternative set")
        more = f" ({others} of the same size; see explain)" if len(failure.causes) > 1 else ""
        cause = (
            "Simulated again, it is not unsafe."
            if failure.cause is None
            else (f"These changes alone cause it: {list_of_changes(characteristics, failure.cause.changes)}{more}.")
        )
        degree = "-" if failure.safety_degree is None else f"{failure.safety_degree:.2f}"
        sentences.append(
            f"{failure.title.capitalize()}: {failure.name}, {failure.outcome}, SD {degree}, {size}. {cause}"
        )
    return sentences


def _limits_in_words(result: Explained, boundary: Mapping[str, float]) -> str:
    return ", ".join(
        f"{full_name(item)} {item.original:g} -> {item.text(boundary[item.name])}{item.suffix}"
        for item in CharacteristicSet.of(result.study.vehicle.characteristics)
        if item.name in boundary
    )


def _most_necessary_in_words(result: Explained) -> str:
    full_names = {item.name: full_name(item) for item in CharacteristicSet.of(result.study.vehicle.characteristics)}
    rows = result.necessity[result.necessity["necessary"] > 0].head(MAX_NECESSARY).to_dict("records")
    return ", ".join(f"{full_names[row['characteristic']]} {necessary_share(row)}" for row in rows) or (
        "none; no change is common to all causes"
    )


def necessary_share(row: Mapping[Any, Any] | pd.Series[Any]) -> str:
    """The share of failures that need a characteristic; with an interval if the failures are a sample."""
    low, high = row["necessary_lower"], row["necessary_upper"]
    interval = f" ({100 * low:.0f} % to {100 * high:.0f} %)" if low < high else ""
    return f"{100 * row['necessary']:.0f} %{interval}"


def full_name(characteristic: Characteristic) -> str:
    """A characteristic's name, with its short name if that differs."""
    name, short_name = characteristic.name, characteristic.short_name
    return name if short_name == name else f"{name} ({short_name})"
