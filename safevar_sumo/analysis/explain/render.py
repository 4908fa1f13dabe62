"""The answer of `explain` on the terminal, the shortest answer first."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.markup import escape

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, sentence
from safevar_sumo.analysis.explain.result import Cause, Explained, Explanation
from safevar_sumo.analysis.explain.sentences import necessary_share
from safevar_sumo.analysis.words import (
    list_of_changes,
    number_of,
    points_in_words,
    question_command,
    simulate_command,
    two_decimals,
)
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, print_constraints, print_heading, print_meanings, print_text
from safevar_sumo.vehicles import CharacteristicSet

MAX_CAUSES = 3
"""Maximum number of minimal causes printed for a failure."""
MAX_DISTINCT_CAUSES = 10
"""Maximum number of distinct minimal causes in the table of all failures."""


def print_explained(console: Console, subject: str, result: Explained, point: str = "", *, full: bool = False) -> None:
    """Print the answer in about ten lines; `full` explains every chosen failure. Printed commands name `subject` and
    `point`.
    """
    print_heading(console, result.study.title, result.no_verdict)
    for line in result.sentences()[bool(result.no_verdict) :]:
        print_text(console, line)
    if result.explanations and (cause := result.explanations[0].cause) and cause.changes:
        print_text(console, f"Try it: {simulate_command(subject, cause.short_boundary, point)}")
    print_constraints(console, result.study)
    if not result.explanations:
        print_text(console, f"How far each characteristic may go: {question_command('tolerance', subject, point)}")
        return
    if not full:
        command = f"{question_command('explain', subject, point)} --full"
        print_text(console, f"{number_of(len(result.explanations), 'failure')} explained in full: {command}")
        return
    print_text(console, _accuracy_in_words(result))
    for failure in result.explanations:
        _print_explanation(console, failure, result, subject, point)
    _print_statistics(console, result)


def _accuracy_in_words(result: Explained) -> str:
    """A sentence on the accuracy of safety degrees: the distance that the vehicle covers between two decisions."""
    step = next(iter(result.explanations[0].robustness.shares_by_step), None)
    braking = result.explanations[0].because.original.braking
    if step is None or braking is None:
        return ""
    return (
        f"Accuracy: the driving system decides every {step:g} s, in which the vehicle covers "
        f"{braking.speed * step:.2f} m at "
        f"{braking.speed:.1f} m/s. Along a characteristic the safety degree is a sawtooth of about that "
        "height: more digits of "
        "a value than a command has mean nothing."
    )


def _print_explanation(console: Console, failure: Explanation, result: Explained, subject: str, point: str) -> None:
    characteristics = CharacteristicSet.of(result.study.vehicle.characteristics)
    console.rule(escape(failure.name), align="left")
    print_text(console, f"Chosen as: {failure.title}")
    ending = (
        f"{failure.outcome}, SD {two_decimals(failure.safety_degree)} with {number_of(len(failure.changed), 'change')}"
    )
    print_text(console, f"{ending}: {list_of_changes(characteristics, failure.setting)}")
    if not failure.causes:
        print_text(console, "It is not unsafe.")
    for cause in failure.causes[:MAX_CAUSES]:
        _print_cause(console, cause, characteristics, subject, point)
    if len(failure.causes) > MAX_CAUSES:
        print_text(
            console, f"... and {len(failure.causes) - MAX_CAUSES} more of the same number of changes (--json has all)."
        )
    if len(failure.causes) > 1:
        print_text(console, f"Necessary, as all of them need it: {', '.join(failure.necessary) or 'nothing'}.")
    print_text(console, f"Because: {sentence(failure.because, full=True)}")
    if failure.because.point:
        point_count = len(assemble(result.study).matrix)
        names, cells = "; ".join(failure.points), f"{len(failure.points)} of {number_of(point_count, 'cell')}"
        print_text(
            console,
            points_in_words(failure.points, point_count, limit=len(failure.points))
            if not is_rated(result.study)
            else f"The colour is worse in {cells}{f': {names}' if names else ''}.",
        )
    if failure.preventable:
        print_text(console, f"In the same vehicle: {failure.preventable}.")
    console.print(_braking_table(failure.because))
    if failure.causes:
        shares = ", ".join(
            f"{100 * share:.0f} % at {step:g} s a step" for step, share in failure.robustness.shares_by_step.items()
        )
        word = "borderline" if failure.robustness.borderline else "robust"
        print_text(
            console,
            (
                f"Unsafe neighbours within the filter's thresholds: {shares}; {word} "
                f"({100 * failure.robustness.share:.0f} %)."
            ),
        )


def _print_cause(console: Console, cause: Cause, characteristics: CharacteristicSet, subject: str, point: str) -> None:
    if not cause.changes:
        print_text(console, "No change is needed: the original vehicle itself is unsafe.")
        return
    changes = list_of_changes(characteristics, cause.changes)
    print_text(console, f"Minimal cause: {changes}: {cause.outcome}, SD {two_decimals(cause.safety_degree)}")
    changed = [characteristic for characteristic in characteristics if characteristic.name in cause.changes]
    table = WholeTable(
        "characteristic", "unit", right=("original", "here", "limit (all scaled)", "limit (this one only)")
    )
    for item in changed:
        values = (item.text(limits[item.name]) for limits in (cause.changes, cause.boundary, cause.alone))
        table.add_row(item.name, item.unit, f"{item.original:g}", *values)
    console.print(table)
    print_meanings(console, changed)
    robustness = "" if cause.neighbours is None else f"By themselves, these changes are {cause.neighbours}. "
    print_text(console, f"{cause.limit} {robustness}{simulate_command(subject, cause.short_changes, point)}")


BRAKING_ROWS: Mapping[str, tuple[str, str, str | None]] = {
    "brakes first at": ("s", "time", None),
    "distance there": ("m", "gap", "gap"),
    "speed there": ("m/s", "speed", "speed"),
    "until the pedal has followed": ("s", "delay", "delay"),
    "speed lost meanwhile": ("m/s", "speed_lost", "slowing"),
    "mean deceleration from then": ("m/s^2", "deceleration", "deceleration"),
    "distance needed": ("m", "stopping_distance", None),
    "distance there - needed": ("m", "margin", "all"),
}
"""Rows of the table of two brakings: unit, attribute of `Braking`, and the part of the lost margin that the row
explains.
"""


def _braking_table(comparison: BrakingComparison) -> WholeTable:
    """Table of the original and the changed vehicle, with the part of the lost margin that each row explains."""
    table, parts = WholeTable("", "unit", right=("original", "changed", "explains, m")), comparison.parts
    explained = {**parts, "all": comparison.lost_margin - parts["remainder"]} if parts else {}
    for label, (unit, name, part) in BRAKING_ROWS.items():
        cells = [
            two_decimals(getattr(run.braking, name)) if run.braking else "-"
            for run in (comparison.original, comparison.changed)
        ]
        table.add_row(label, unit, *cells, two_decimals(explained[part]) if part in explained else "")
    if parts:
        table.add_row("not explained", "m", "", "", two_decimals(parts["remainder"]))
    return table


def _print_statistics(console: Console, result: Explained) -> None:
    table = WholeTable(
        "characteristic",
        right=("changed", "necessary", "in some cause"),
        title=f"Changed vs. necessary ({result.sample})",
    )
    for row in result.necessity.to_dict("records"):
        table.add_row(
            row["characteristic"],
            f"{100 * row['changed']:.0f} %",
            necessary_share(row),
            f"{100 * row['involved']:.0f} %",
        )
    console.print(table)
    intervals = (
        ""
        if result.analysed == result.failures
        else (
            f" In brackets: {100 * CONFIDENCE:.0f} % intervals for all {result.failures} (Clopper and "
            "Pearson's, slightly too wide)."
        )
    )
    print_text(
        console,
        "Shares of the failures. necessary: every minimal cause of a failure contains it, none does without; "
        f"in some cause: at least one minimal cause contains it, others may do without.{intervals}",
    )
    causes = WholeTable(
        "minimal cause", right=("failures", "share"), title=f"Distinct minimal causes: {len(result.distinct)}"
    )
    for row in result.distinct.head(MAX_DISTINCT_CAUSES).to_dict("records"):
        causes.add_row(
            ", ".join(row["cause"]) or "none: the original vehicle", str(row["failures"]), f"{100 * row['share']:.0f} %"
        )
    console.print(causes)
