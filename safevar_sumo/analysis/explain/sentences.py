"""The answer of `explain` in sentences, the verdict first: the summary of `study`, `explain` and reports say the
same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from safevar_sumo.analysis.explain.braking_comparison import sentence
from safevar_sumo.analysis.words import (
    OUTCOME_VERBS,
    list_of_changes,
    number_of,
    question_command,
    simulate_command,
    two_decimals,
)
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import KMH_PER_MS, Evaluations, Outcome
from safevar_sumo.scenarios import distance_in_words, equals_clear, weather_in_words
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.terminal import WholeTable, constraints_in_words, meanings, print_answer
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
MAX_CAUSES, MAX_DISTINCT_CAUSES = 3, 10
"""Maximum number of minimal causes printed for a failure, and of distinct ones in the table of all failures."""
MAX_NECESSARY = 4
"""Maximum number of characteristics named as necessary most often."""


def answer_in_words(result: Explained) -> list[str]:
    """The verdict as a paragraph, the counts, and why and by how little the first failure fails."""
    sentences = [" ".join(verdict_in_words(result)), counts_in_words(result)]
    if not result.explanations:
        return sentences
    first = result.explanations[0]
    sentences.append(f"Why {first.name} fails: {sentence(first.because)}")
    if first.cause and first.cause.changes:
        limits = ", ".join(
            f"{full_name(item)} {item.original:g} -> {item.text(first.cause.boundary[item.name])}{item.suffix}"
            for item in result.characteristics
            if item.name in first.cause.boundary
        )
        sentences.append(f"How little is enough: {limits}.")
    if result.analysed and len(result.distinct):
        common, full_names = result.distinct.iloc[0], {item.name: full_name(item) for item in result.characteristics}
        rows = result.necessity[result.necessity["necessary"] > 0].head(MAX_NECESSARY).to_dict("records")
        necessary = ", ".join(f"{full_names[row['characteristic']]} {necessary_share(row)}" for row in rows)
        sentences += [
            f"In every cause of a failure most often ({result.sample}): {necessary or 'no change is common to all'}.",
            f"{number_of(len(result.distinct), 'distinct minimal cause')}; the most frequent: "
            f"{', '.join(common['cause']) or 'none'} ({100 * common['share']:.0f} % of the failures).",
        ]
    return sentences


def counts_in_words(result: Explained) -> str:
    """The criterion, how many settings are unsafe by it, and in which range with other fitted vehicle models."""
    vehicles = number_of(result.looked_at, "different vehicle")
    parts = [f"{result.failures} of {vehicles} are unsafe: {result.unsafe.description}."]
    if result.otherwise:
        parts.append(f"{number_of(result.otherwise, 'setting')} with another outcome than recorded.")
    return " ".join([*parts, *([str(result.across_fits)] if result.across_fits else [])])


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
        other = None if robust is None else finding_in_words(system.characteristics, robust)
        parts.append(
            f"The robust failure with the fewest changes: {other}" if other else "No failure tested is robust."
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
    shares = {
        item.short_name: (failure.setting[item.name] - item.original) / abs(item.original)
        for item in characteristics
        if item.name in failure.changed
    }
    largest = sorted(shares.items(), key=lambda share: -abs(share[1]))[:MAX_CHANGES_LISTED]
    changes = ", ".join(f"{name} {100 * share:+.0f} %" for name, share in largest)
    changes += f" and {number - MAX_CHANGES_LISTED} more" if number > MAX_CHANGES_LISTED else ""
    effect = f"{effect_in_words(failure)} ({failure.name}, {failure.robustness})"
    if cause is None or len(cause.changes) == number:
        return f"{effect} needs all of {number_of(number, 'change')}: {changes}."
    notes = [] if cause.neighbours is None else [str(cause.neighbours)]
    notes += [cause.fits_in_words] if cause.sets else []
    needed = f"{_number_in_words(len(cause.changes))} of them suffice{'s' if len(cause.changes) == 1 else ''}"
    in_brackets = f" ({'; '.join(notes)})" if notes else ""
    return f"{effect} was found with {_number_in_words(number)} changes: {changes}; {needed}{in_brackets}."


def _number_in_words(number: int) -> str:
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
    """A sentence for each failure that was chosen by its size or severity: its effect, and the cause that is named."""
    return [
        f"{failure.title.capitalize()}: {failure.name}, {effect_in_words(failure)}. These changes alone cause it: "
        f"{list_of_changes(result.characteristics, failure.cause.changes)}."
        for failure in result.choices
        if failure.cause
    ]


def necessary_share(row: Mapping[Any, Any]) -> str:
    """The share of failures that need a characteristic; with an interval if the failures are a sample."""
    low, high = row["necessary_lower"], row["necessary_upper"]
    interval = f" ({100 * low:.0f} % to {100 * high:.0f} %)" if low < high else ""
    return f"{100 * row['necessary']:.0f} %{interval}"


def full_name(characteristic: Characteristic) -> str:
    """A characteristic's name, with its short name if that differs."""
    name, short_name = characteristic.name, characteristic.short_name
    return name if short_name == name else f"{name} ({short_name})"


def print_explained(console: Console, subject: str, result: Explained, point: str = "", *, full: bool = False) -> None:
    """Print the answer in about ten lines; `full` explains every chosen failure. Printed commands name `subject` and
    `point`.
    """
    print_answer(console, result.study, result.no_verdict, _parts(subject, result, point, full=full))


def _parts(subject: str, result: Explained, point: str, *, full: bool) -> Iterator[str | Table]:
    yield from result.sentences()
    if not result.explanations:
        yield f"How far each characteristic may go: {question_command('tolerance', subject, point)}"
        return
    if (cause := result.explanations[0].cause) and cause.changes:
        yield f"Try it: {simulate_command(subject, cause.boundary, point)}"
    yield from constraints_in_words(result.study)
    if not full:
        command = f"{question_command('explain', subject, point)} --full"
        yield f"{number_of(len(result.explanations), 'failure')} explained in full: {command}"
        return
    step = next(iter(result.explanations[0].robustness.shares_by_step))
    if braking := result.explanations[0].because.original.braking:
        yield (
            f"Accuracy: the driving system decides every {step:g} s, in which the vehicle covers "
            f"{braking.speed * step:.2f} m at {braking.speed:.1f} m/s. Along a characteristic the safety degree is a "
            "sawtooth of about that height: more digits of a value than a command has mean nothing."
        )
    for failure in result.explanations:
        yield from _parts_of_failure(failure, result, subject, point)
    yield from _statistics(result)


def _parts_of_failure(failure: Explanation, result: Explained, subject: str, point: str) -> Iterator[str | Table]:
    yield f"\n{failure.name} ({failure.title})"
    ending = f"{failure.outcome}, SD {two_decimals(failure.safety_degree)}"
    yield f"{ending} with {list_of_changes(result.characteristics, failure.setting)}"
    for cause in failure.causes[:MAX_CAUSES]:
        if not cause.changes:
            yield "No change is needed: the original vehicle itself is unsafe."
            continue
        yield (
            f"Minimal cause: {list_of_changes(result.characteristics, cause.changes)}: {cause.outcome}, "
            f"SD {two_decimals(cause.safety_degree)}"
        )
        changed = [item for item in result.characteristics if item.name in cause.changes]
        table = WholeTable(
            "characteristic", "unit", right=("original", "here", "limit (all scaled)", "limit (this one only)")
        )
        for item in changed:
            values = (item.text(limits[item.name]) for limits in (cause.changes, cause.boundary, cause.alone))
            table.add_row(item.name, item.unit, f"{item.original:g}", *values)
        yield table
        yield meanings(changed)
        robustness = "" if cause.neighbours is None else f"By themselves, these changes are {cause.neighbours}. "
        robustness += f"They are a cause {cause.fits_in_words}. " if cause.sets else ""
        yield f"{cause.limit} {robustness}{simulate_command(subject, cause.changes, point)}"
    if len(failure.causes) > MAX_CAUSES:
        yield f"... and {len(failure.causes) - MAX_CAUSES} more of the same number of changes (--json has all)."
    if len(failure.causes) > 1:
        yield f"Necessary, as all of them need it: {', '.join(failure.necessary) or 'nothing'}."
    yield f"Because: {sentence(failure.because)}"
    if failure.because.point:
        fails = "The colour is worse" if is_rated(result.study) else "Fails"
        yield f"{fails} at {number_of(len(failure.points), 'point')}: {'; '.join(failure.points) or 'none'}."
    if failure.preventable:
        yield f"In the same vehicle: {failure.preventable}."
    if failure.causes:
        yield f"It is {failure.robustness}."


def _statistics(result: Explained) -> Iterator[str | Table]:
    table = WholeTable(
        "characteristic",
        right=("changed", "necessary", "in some cause"),
        title=f"Changed vs. necessary ({result.sample})",
    )
    for row in result.necessity.to_dict("records"):
        shares = f"{100 * row['changed']:.0f} %", necessary_share(row), f"{100 * row['involved']:.0f} %"
        table.add_row(row["characteristic"], *shares)
    yield table
    yield (
        "Shares of the failures. necessary: every minimal cause of a failure contains it, none does without; in some "
        "cause: at least one minimal cause contains it, others may do without. In brackets: 95 % intervals for all "
        f"{number_of(result.failures, 'failure')} (Clopper and Pearson's), where only a sample was analysed."
    )
    causes = WholeTable(
        "minimal cause", right=("failures", "share"), title=f"Distinct minimal causes: {len(result.distinct)}"
    )
    for row in result.distinct.head(MAX_DISTINCT_CAUSES).to_dict("records"):
        name = ", ".join(row["cause"]) or "none: the original vehicle"
        causes.add_row(name, str(row["failures"]), f"{100 * row['share']:.0f} %")
    yield causes
