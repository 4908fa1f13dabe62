"""Failures explained, for a reader: the shortest answer first."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rich.console import Console
from rich.markup import escape

from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison
from safevar_sumo.analysis.explain.compute import REASONS, ROBUST
from safevar_sumo.analysis.explain.failures import points_in_words
from safevar_sumo.analysis.explain.necessity import CONFIDENCE
from safevar_sumo.analysis.explain.result import Cause, Explained, Explanation
from safevar_sumo.analysis.explain.summary import Finding, in_short
from safevar_sumo.analysis.words import ask, changes, command, number_of, sentence
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, print_meanings
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

CAUSES_SHOWN = 3
"""Minimal causes of a failure, and distinct ones of all failures, that a table has room for."""
DISTINCT_SHOWN = 10
NECESSARY_SHOWN = 4
Again = Callable[[Mapping[str, float]], str]
"""The command that simulates these changes."""


def print_explained(console: Console, place: str, told: Explained, point: str = "", *, full: bool = False) -> None:
    """The answer in about ten lines; `full` explains every chosen failure. Commands that are told are about `place`, and its `point`."""
    members = CharacteristicSet.of(told.study.vehicle.characteristics)
    _say(console, told.study.title)
    _say(console, f"Unsafe: {told.unsafe}. {number_of(told.failures, 'failure')} among {told.looked_at} different settings.")
    if told.otherwise:
        _say(console, f"note: {number_of(told.otherwise, 'setting')} not as the results say when simulated again: another version or code?")
    if not told.explanations:
        _say(console, f"Nothing unsafe found. How far each characteristic may go: {ask('tolerance', place, point)}")
        return
    again: Again = partial(command, place, point=point)
    _print_answer(console, again, told, members)
    if not full:
        _say(console, f"{number_of(len(told.explanations), 'failure')} explained in full: {ask('explain', place, point)} --full")
        return
    _say(console, _sawtooth(told))
    for one in told.explanations:
        _print_one(console, again, one, members, told)
    if told.preventability.looked_at:
        _say(console, str(told.preventability))
    _print_common(console, told)


def _print_answer(console: Console, again: Again, told: Explained, members: CharacteristicSet) -> None:
    """The paragraph; of the failure that leads, why and how little is enough; which changes and causes are common."""
    first = told.explanations[0]
    by_reason = {reason: one for one in told.explanations for reason in one.reasons}
    smallest, robust = by_reason.get(REASONS["fewest"], first), by_reason.get(ROBUST)
    _say(console, in_short(assemble(told.study), told.original, _finding(smallest), _finding(robust), told.preventability))
    name = str(first.handle or "the first setting")
    _say(console, f"Why, of {name}: {sentence(first.because)}")
    for cause in [one for one in first.causes if one.changes][:1]:
        limits = [f"{_named(member)} {member.original:g} -> {member.text(cause.boundary[member.name])}{member.suffix}"
                  for member in members if member.name in cause.boundary]
        _say(console, f"How little is enough: {', '.join(limits)}. {again(cause.boundary)}")
    if told.analysed and len(told.distinct):
        _say(console, f"Necessary most often ({_looked_at(told)}): {_most_necessary(told, members)}.")
        common = told.distinct.iloc[0]
        _say(console, f"{number_of(len(told.distinct), 'distinct minimal cause')}; the most frequent: "
                      f"{', '.join(common['cause']) or 'none'} ({common['share']:.0%} of the failures).")


def _finding(one: Explanation | None) -> Finding | None:
    """A failure as the paragraph tells of it; None for what is not unsafe."""
    if one is None or not one.causes:
        return None
    return Finding(str(one.handle or "a setting of its own"), {name: one.setting[name] for name in one.changed}, one.outcome,
                   one.safety_degree, one.robustness, len(one.causes[0].changes))


def _most_necessary(told: Explained, members: CharacteristicSet) -> str:
    called = {member.name: _named(member) for member in members}
    rows = told.necessity[told.necessity["necessary"] > 0].head(NECESSARY_SHOWN).to_dict("records")
    return ", ".join(f"{called[row['characteristic']]} {_necessary(row)}" for row in rows) or "none, causes differ"


def _necessary(row: Mapping[Any, Any]) -> str:
    """The share of failures that need a characteristic, with the interval of a sample."""
    interval = f" ({row['necessary_lower']:.0%} to {row['necessary_upper']:.0%})" if row["necessary_lower"] < row["necessary_upper"] else ""
    return f"{row['necessary']:.0%}{interval}"


def _named(member: Characteristic) -> str:
    """Its name with what it is, in short."""
    return member.name if member.short_name == member.name else f"{member.name} ({member.short_name})"


def _sawtooth(told: Explained) -> str:
    """How exact a value along a characteristic can be: the way that the vehicle covers between two decisions."""
    step = next(iter(told.explanations[0].robustness.by_step), None)
    braking = told.explanations[0].because.original.braking
    if step is None or braking is None:
        return ""
    return (f"How exact: decisions fall into frames of {step:g} s, in which the vehicle covers {braking.speed * step:.2f} m at "
            f"{braking.speed:.1f} m/s. Along a characteristic the safety degree is a sawtooth of about that height: more digits of "
            "a value mean nothing.")


def _print_one(console: Console, again: Again, one: Explanation, members: CharacteristicSet, told: Explained) -> None:
    title = f"{', '.join(one.reasons)}: {one.handle or 'a setting of its own'}"
    console.rule(escape(title), align="left")
    ends = f"{one.outcome}, SD {_decimal(one.safety_degree)} with {number_of(len(one.changed), 'change')}"
    _say(console, f"{ends}: {changes(members, one.setting)}")
    if not one.causes:
        _say(console, "It is not unsafe.")
    for cause in one.causes[:CAUSES_SHOWN]:
        _print_cause(console, again, cause, members)
    if len(one.causes) > CAUSES_SHOWN:
        _say(console, f"... and {len(one.causes) - CAUSES_SHOWN} more of the same number of changes (--json has all).")
    if len(one.causes) > 1:
        _say(console, f"Needed by all of them: {', '.join(one.necessary) or 'nothing'}.")
    _say(console, f"Because: {sentence(one.because)}")
    if one.because.place:
        number = len(assemble(told.study).matrix)
        _say(console, points_in_words(one.points, number, most=len(one.points)))
    if one.preventable:
        _say(console, f"In the same vehicle: {one.preventable}.")
    console.print(_side_by_side(one.because))
    if one.causes:
        shares = ", ".join(f"{share:.0%} at {step:g} s a step" for step, share in one.robustness.by_step.items())
        word = "borderline" if one.robustness.borderline else "robust"
        _say(console, f"Neighbours within the filter's thresholds that are unsafe too: {shares}; {word} ({one.robustness.share:.0%}).")


def _print_cause(console: Console, again: Again, cause: Cause, members: CharacteristicSet) -> None:
    if not cause.changes:
        _say(console, "No change is needed: the original vehicle itself is unsafe.")
        return
    _say(console, f"Minimal cause: {changes(members, cause.changes)}: {cause.outcome}, SD {_decimal(cause.safety_degree)}")
    table = WholeTable("characteristic", "unit")
    for head in ("original", "here", "limit (all scaled)", "limit (this one only)"):
        table.add_column(head, justify="right")
    for member in members:
        if member.name in cause.changes:
            values = (cause.changes[member.name], cause.boundary[member.name], cause.alone[member.name])
            table.add_row(escape(member.name), escape(member.unit), f"{member.original:g}", *(member.text(value) for value in values))
    console.print(table)
    print_meanings(console, [member for member in members if member.name in cause.changes])
    _say(console, f"{cause.limit} {again(cause.changes)}")


def _side_by_side(told: BrakingComparison) -> WholeTable:
    """Original and changed vehicle, and what each line explains of the lost distance."""
    table = WholeTable("", "unit")
    for head in ("original", "changed", "explains, m"):
        table.add_column(head, justify="right")
    one, other = told.original.braking, told.changed.braking
    rows = (("brakes first at", "s", "time", None), ("distance there", "m", "gap", "place"), ("speed there", "m/s", "speed", "speed"),
            ("until the pedal has followed", "s", "delay", "delay"), ("speed lost meanwhile", "m/s", "speed_lost", "slowing"),
            ("mean deceleration from then", "m/s^2", "deceleration", "deceleration"), ("distance needed", "m", "needed", None),
            ("distance there - needed", "m", "margin", "all"))
    for head, unit, field, part in rows:
        cells = [_decimal(getattr(braking, field)) if braking else "-" for braking in (one, other)]
        explains = {"all": told.lost - told.parts.get("remainder", 0.0), **told.parts}.get(part) if part and told.parts else None
        table.add_row(head, unit, *cells, "" if explains is None else f"{explains:.2f}")
    if told.parts:
        table.add_row("not explained", "m", "", "", f"{told.parts['remainder']:.2f}")
    return table


def _print_common(console: Console, told: Explained) -> None:
    table = WholeTable("characteristic", title=f"Changed vs. necessary ({_looked_at(told)})", title_justify="left")
    for head in ("changed", "necessary", "in some cause"):
        table.add_column(head, justify="right")
    for row in told.necessity.to_dict("records"):
        table.add_row(escape(row["characteristic"]), f"{row['changed']:.0%}", _necessary(row), f"{row['involved']:.0%}")
    console.print(table)
    sampled = "" if told.analysed == told.failures else (
        f" In brackets: {CONFIDENCE:.0%} intervals for all {told.failures} (Clopper and Pearson's, a little too wide for a finite number).")
    _say(console, f"necessary: in every minimal cause of a failure; shares of the failures.{sampled}")
    causes = WholeTable("minimal cause", title=f"Distinct minimal causes: {len(told.distinct)}", title_justify="left")
    for head in ("failures", "share"):
        causes.add_column(head, justify="right")
    for row in told.distinct.head(DISTINCT_SHOWN).to_dict("records"):
        causes.add_row(escape(", ".join(row["cause"]) or "none: the original vehicle"), str(row["failures"]), f"{row['share']:.0%}")
    console.print(causes)


def _looked_at(told: Explained) -> str:
    if told.analysed == told.failures:
        return f"all {told.failures} failures"
    return f"random sample: {told.analysed} of {told.failures} failures"


def _decimal(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.2f}"


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)
