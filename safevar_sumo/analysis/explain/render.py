"""The result of `explain` as text, the shortest answer first, and as a figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape

from safevar_sumo.analysis.evaluator import CONFIDENCE
from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, sentence
from safevar_sumo.analysis.explain.paragraph import FailureDescription, failures_paragraph
from safevar_sumo.analysis.explain.result import LABELS, REASONS, ROBUST, Cause, Explained, Explanation, most_robust
from safevar_sumo.analysis.figures import BLUE, FONT, GREY, SKY_BLUE, escape_dollars, new_figure
from safevar_sumo.analysis.words import list_of_changes, number_of, points_in_words, question_command, simulate_command, two_decimals
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, print_constraints, print_heading, print_meanings, print_text
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_CAUSES = 3
"""Maximum number of minimal causes printed for a failure."""
MAX_DISTINCT_CAUSES = 10
"""Maximum number of distinct minimal causes in the table of all failures."""
MAX_NECESSARY = 4
"""Maximum number of characteristics named as necessary most often."""
CommandFor = Callable[[Mapping[str, float]], str]
"""Returns the command that simulates the given changes."""


def print_explained(console: Console, subject: str, result: Explained, point: str = "", *, full: bool = False) -> None:
    """Print the answer in about ten lines; `full` explains every chosen failure. Printed commands name `subject` and the test `point`."""
    characteristics = CharacteristicSet.of(result.study.vehicle.characteristics)
    print_heading(console, result.study.title, result.no_verdict)
    print_text(console, f"Unsafe: {result.unsafe.description}. {number_of(result.failures, 'failure')} among {result.looked_at} different "
                        "settings.")
    print_constraints(console, result.study)
    if result.otherwise:
        print_text(console, f"note: {number_of(result.otherwise, 'setting')} with another outcome than recorded. "
                            "Has the version or the code changed?")
    if not result.explanations:
        print_text(console, f"Nothing unsafe found. How far each characteristic may go: {question_command('tolerance', subject, point)}")
        return
    command_for: CommandFor = partial(simulate_command, subject, point=point)
    _print_answer(console, command_for, result, characteristics)
    if not full:
        print_text(console, f"{number_of(len(result.explanations), 'failure')} explained in full: "
                            f"{question_command('explain', subject, point)} --full")
        return
    print_text(console, _accuracy_in_words(result))
    for failure in result.explanations:
        _print_explanation(console, command_for, failure, characteristics, result)
    _print_statistics(console, result)


def _print_answer(console: Console, command_for: CommandFor, result: Explained, characteristics: CharacteristicSet) -> None:
    """Print a paragraph, the reason and the boundary of the first failure, and the most frequent changes and causes."""
    first = result.explanations[0]
    by_reason = {reason: failure for failure in result.explanations for reason in failure.reasons}
    smallest, robust = by_reason.get(REASONS["fewest"], first), by_reason.get(ROBUST)
    descriptions = _describe(smallest), _describe(robust)
    print_text(console, failures_paragraph(assemble(result.study), result.original, *descriptions, result.preventability))
    name = str(first.handle or "the first setting")
    print_text(console, f"Why {name} fails: {sentence(first.because, full=True)}")
    if cause := most_robust(cause for cause in first.causes if cause.changes):
        limits = [f"{_full_name(characteristic)} {characteristic.original:g} -> "
                  f"{characteristic.text(cause.boundary[characteristic.name])}{characteristic.suffix}"
                  for characteristic in characteristics if characteristic.name in cause.boundary]
        print_text(console, f"How little is enough: {', '.join(limits)}. {command_for(cause.short_boundary)}")
    if result.analysed and len(result.distinct):
        print_text(console, f"Necessary most often ({_sample_in_words(result)}): {_most_necessary_in_words(result, characteristics)}.")
        common = result.distinct.iloc[0]
        print_text(console, f"{number_of(len(result.distinct), 'distinct minimal cause')}; the most frequent: "
                      f"{', '.join(common['cause']) or 'none'} ({100 * common['share']:.0f} % of the failures).")


def _describe(failure: Explanation | None) -> FailureDescription | None:
    """The description of a failure for the paragraph; None without a failure, or if its setting is not unsafe."""
    if failure is None or not failure.causes:
        return None
    changes, cause = {name: failure.setting[name] for name in failure.changed}, most_robust(failure.causes)
    return FailureDescription(
        str(failure.handle or "a sampled setting"), changes, failure.outcome, failure.safety_degree, failure.robustness,
        len(failure.causes[0].changes), None if cause is None else cause.neighbours)


def _most_necessary_in_words(result: Explained, characteristics: CharacteristicSet) -> str:
    full_names = {characteristic.name: _full_name(characteristic) for characteristic in characteristics}
    rows = result.necessity[result.necessity["necessary"] > 0].head(MAX_NECESSARY).to_dict("records")
    shares = (f"{full_names[row['characteristic']]} {_necessary_share(row)}" for row in rows)
    return ", ".join(shares) or "none; no change is common to all causes"


def _necessary_share(row: Mapping[Any, Any]) -> str:
    """The share of failures that need a characteristic; with an interval if the failures are a sample."""
    low, high = row["necessary_lower"], row["necessary_upper"]
    interval = f" ({100 * low:.0f} % to {100 * high:.0f} %)" if low < high else ""
    return f"{100 * row['necessary']:.0f} %{interval}"


def _full_name(characteristic: Characteristic) -> str:
    """A characteristic's name, with its short name if that differs."""
    name, short_name = characteristic.name, characteristic.short_name
    return name if short_name == name else f"{name} ({short_name})"


def _accuracy_in_words(result: Explained) -> str:
    """A sentence on the accuracy of safety degrees: the distance that the vehicle covers between two decisions."""
    step = next(iter(result.explanations[0].robustness.shares_by_step), None)
    braking = result.explanations[0].because.original.braking
    if step is None or braking is None:
        return ""
    return (f"Accuracy: the driving system decides every {step:g} s, in which the vehicle covers {braking.speed * step:.2f} m at "
            f"{braking.speed:.1f} m/s. Along a characteristic the safety degree is a sawtooth of about that height: more digits of "
            "a value than a command has mean nothing.")


def _print_explanation(console: Console, command_for: CommandFor, failure: Explanation, characteristics: CharacteristicSet,
                       result: Explained) -> None:
    console.rule(escape(str(failure.handle or "a sampled setting")), align="left")
    print_text(console, f"Chosen as: {', '.join(LABELS.get(reason, reason) for reason in failure.reasons)}")
    ending = f"{failure.outcome}, SD {two_decimals(failure.safety_degree)} with {number_of(len(failure.changed), 'change')}"
    print_text(console, f"{ending}: {list_of_changes(characteristics, failure.setting)}")
    if not failure.causes:
        print_text(console, "It is not unsafe.")
    for cause in failure.causes[:MAX_CAUSES]:
        _print_cause(console, command_for, cause, characteristics)
    if len(failure.causes) > MAX_CAUSES:
        print_text(console, f"... and {len(failure.causes) - MAX_CAUSES} more of the same number of changes (--json has all).")
    if len(failure.causes) > 1:
        print_text(console, f"Needed by all of them: {', '.join(failure.necessary) or 'nothing'}.")
    print_text(console, f"Because: {sentence(failure.because, full=True)}")
    if failure.because.point:
        point_count = len(assemble(result.study).matrix)
        if is_rated(result.study):
            cells = f"{len(failure.points)} of {number_of(point_count, 'cell')}"
            print_text(console, f"The colour is worse in {cells}{': ' if failure.points else ''}{'; '.join(failure.points)}.")
        else:
            print_text(console, points_in_words(failure.points, point_count, limit=len(failure.points)))
    if failure.preventable:
        print_text(console, f"In the same vehicle: {failure.preventable}.")
    console.print(_braking_table(failure.because))
    if failure.causes:
        shares = ", ".join(f"{100 * share:.0f} % at {step:g} s a step" for step, share in failure.robustness.shares_by_step.items())
        word = "borderline" if failure.robustness.borderline else "robust"
        print_text(console, f"Unsafe neighbours within the filter's thresholds: {shares}; {word} ({100 * failure.robustness.share:.0f} %).")


def _print_cause(console: Console, command_for: CommandFor, cause: Cause, characteristics: CharacteristicSet) -> None:
    if not cause.changes:
        print_text(console, "No change is needed: the original vehicle itself is unsafe.")
        return
    changes = list_of_changes(characteristics, cause.changes)
    print_text(console, f"Minimal cause: {changes}: {cause.outcome}, SD {two_decimals(cause.safety_degree)}")
    table = WholeTable("characteristic", "unit", right=("original", "here", "limit (all scaled)", "limit (this one only)"))
    for characteristic in characteristics:
        if (name := characteristic.name) in cause.changes:
            values = (characteristic.text(limits[name]) for limits in (cause.changes, cause.boundary, cause.alone))
            table.add_row(name, characteristic.unit, f"{characteristic.original:g}", *values)
    console.print(table)
    print_meanings(console, [characteristic for characteristic in characteristics if characteristic.name in cause.changes])
    robustness = "" if cause.neighbours is None else f"By themselves, these changes are {cause.neighbours}. "
    print_text(console, f"{cause.limit} {robustness}{command_for(cause.short_changes)}")


def _braking_table(comparison: BrakingComparison) -> WholeTable:
    """Table of the original and the changed vehicle, with the part of the lost margin that each row explains."""
    table = WholeTable("", "unit", right=("original", "changed", "explains, m"))
    parts = comparison.parts
    brakings = comparison.original.braking, comparison.changed.braking
    rows = (("brakes first at", "s", "time", None), ("distance there", "m", "gap", "gap"), ("speed there", "m/s", "speed", "speed"),
            ("until the pedal has followed", "s", "delay", "delay"), ("speed lost meanwhile", "m/s", "speed_lost", "slowing"),
            ("mean deceleration from then", "m/s^2", "deceleration", "deceleration"), ("distance needed", "m", "stopping_distance", None),
            ("distance there - needed", "m", "margin", "all"))
    for label, unit, field, part in rows:
        cells = [two_decimals(getattr(braking, field)) if braking else "-" for braking in brakings]
        distance = {"all": comparison.lost_margin - parts["remainder"], **parts}[part] if part and parts else None
        table.add_row(label, unit, *cells, "" if distance is None else two_decimals(distance))
    if parts:
        table.add_row("not explained", "m", "", "", two_decimals(parts["remainder"]))
    return table


def _print_statistics(console: Console, result: Explained) -> None:
    table = WholeTable("characteristic", right=("changed", "necessary", "in some cause"),
                       title=f"Changed vs. necessary ({_sample_in_words(result)})")
    for row in result.necessity.to_dict("records"):
        table.add_row(row["characteristic"], f"{100 * row['changed']:.0f} %", _necessary_share(row), f"{100 * row['involved']:.0f} %")
    console.print(table)
    intervals = "" if result.analysed == result.failures else (
        f" In brackets: {100 * CONFIDENCE:.0f} % intervals for all {result.failures} (Clopper and Pearson's, slightly too wide).")
    print_text(console, f"necessary: in every minimal cause of a failure; shares of the failures.{intervals}")
    causes = WholeTable("minimal cause", right=("failures", "share"), title=f"Distinct minimal causes: {len(result.distinct)}")
    for row in result.distinct.head(MAX_DISTINCT_CAUSES).to_dict("records"):
        causes.add_row(", ".join(row["cause"]) or "none: the original vehicle", str(row["failures"]), f"{100 * row['share']:.0f} %")
    console.print(causes)


def _sample_in_words(result: Explained) -> str:
    if result.analysed == result.failures:
        return {1: "the only failure", 2: "both failures"}.get(result.failures, f"all {result.failures} failures")
    return f"random sample: {result.analysed} of {result.failures} failures"


def necessity_figure(result: Explained) -> Figure:
    """How often each characteristic is necessary, beside how often it is changed (as RQ3.2 counts)."""
    frame = result.necessity.iloc[::-1]
    figure, ((axis,),) = new_figure(f"{result.study.name}: changed vs. necessary", 1, 1, (6.4, 1.4 + 0.3 * max(len(frame), 4)))
    names = [escape_dollars(name) for name in frame["characteristic"]]
    for column, label, colour, height in (
            ("changed", "changed", GREY, 0.8), ("involved", "in some minimal cause", SKY_BLUE, 0.5),
            ("necessary", "necessary: in every minimal cause", BLUE, 0.24)):
        axis.barh(names, 100 * frame[column], height=height, color=colour, label=label)
    axis.set_xlim(0, 100)
    axis.set_xlabel(f"share of {result.analysed} failures [%]")
    axis.grid(visible=False, axis="y")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=FONT)
    return figure
