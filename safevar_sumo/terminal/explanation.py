"""Failures explained, for a reader: the shortest answer first."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

from rich.console import Console
from rich.markup import escape

from safevar_sumo.answers import (
    BrakingComparison,
    Cause,
    Explained,
    Explanation,
    ask,
    changes,
    command,
    number_of,
    points_in_words,
    sentence,
)
from safevar_sumo.simulation import assemble
from safevar_sumo.terminal.plain import WholeTable, print_meanings
from safevar_sumo.vehicles import CharacteristicSet

CAUSES_SHOWN = 3
"""Minimal causes of a failure, and distinct ones of all failures, that a table has room for."""
DISTINCT_SHOWN = 10
Again = Callable[[Mapping[str, float]], str]
"""The command that simulates these changes."""


def print_explained(console: Console, place: str, told: Explained, point: str = "") -> None:
    """Every explanation, then what all failures have in common; commands that are told are about `place`, and its `point`."""
    members = CharacteristicSet.of(told.study.vehicle.characteristics)
    _say(console, told.study.title)
    _say(console, f"Unsafe: {told.unsafe}. {number_of(told.failures, 'failure')} among {told.looked_at} different settings.")
    if told.otherwise:
        _say(console, f"note: {number_of(told.otherwise, 'setting')} not as the results say when simulated again: another version or code?")
    if not told.explanations:
        _say(console, f"Nothing unsafe found. How far each characteristic may go: {ask('tolerance', place, point)}")
        return
    for one in told.explanations:
        _print_one(console, partial(command, place, point=point), one, members, told)
    if told.preventability.looked_at:
        _say(console, str(told.preventability))
    _print_common(console, told)


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
    for head in ("original", "here", "all shrunk", "alone back to"):
        table.add_column(head, justify="right")
    for member in members:
        if member.name in cause.changes:
            values = (member.original, cause.changes[member.name], cause.boundary[member.name], cause.alone[member.name])
            table.add_row(escape(member.name), escape(member.unit), *(f"{value:.6g}" for value in values))
    console.print(table)
    print_meanings(console, [member for member in members if member.name in cause.changes])
    _say(console, f"Still unsafe at {cause.fraction:.1%} of these changes, safe just below. {again(cause.changes)}")


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
    looked = "all of them" if told.analysed == told.failures else f"a random sample of {told.analysed} of the {told.failures}"
    table = WholeTable("characteristic", title=f"Changed is not needed: {looked}", title_justify="left")
    for head in ("changed", "necessary", "in some cause"):
        table.add_column(head, justify="right")
    for row in told.necessity.to_dict("records"):
        table.add_row(escape(row["characteristic"]), *(f"{row[name]:.0%}" for name in ("changed", "necessary", "involved")))
    console.print(table)
    console.print("necessary: in every minimal cause of a failure; shares of the failures.")
    causes = WholeTable("minimal cause", title=f"Distinct minimal causes: {len(told.distinct)}", title_justify="left")
    for head in ("failures", "share"):
        causes.add_column(head, justify="right")
    for row in told.distinct.head(DISTINCT_SHOWN).to_dict("records"):
        causes.add_row(escape(", ".join(row["cause"]) or "none: the original vehicle"), str(row["failures"]), f"{row['share']:.0%}")
    console.print(causes)


def _decimal(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.2f}"


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)
