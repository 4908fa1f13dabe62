"""How far characteristics may go, for a reader."""

from __future__ import annotations

import math

from rich.console import Console
from rich.markup import escape

from safevar_sumo.analysis.tolerance.compute import Tolerance
from safevar_sumo.analysis.tolerance.one_at_a_time import OneAtATimeScan
from safevar_sumo.terminal import WholeTable, print_meanings
from safevar_sumo.vehicles import Characteristic

PAIRS_SHOWN = 12


def print_tolerance(console: Console, told: Tolerance) -> None:
    """The verdict, each characteristic alone, the worst pairs, and all together."""
    degree = "-" if math.isnan(told.original.f_safe[0]) else f"{told.original.f_safe[0]:.2f}"
    _say(console, told.study.title)
    _say(console, f"Unsafe: {told.unsafe}. The original vehicle: {told.original.outcome[0]}, SD {degree}.")
    _say(console, told.verdict)
    console.print(_alone(told))
    _say(console, "* the end of the domain: nothing beyond was looked at.")
    print_meanings(console, [one.characteristic for one in told.alone])
    if told.pairs:
        _print_pairs(console, told)
    _say(console, _together(told))


def _together(told: Tolerance) -> str:
    box = told.joint
    subset = len(box.characteristics) < len(told.study.vehicle.characteristics)
    who = f"{', '.join(box.characteristics)} together, the others as in the original" if subset else "All together"
    if not box.factor:
        return f"{who}: no box around the original is safe."
    failed = f"; {box.failed} of them could not be simulated and count as unsafe in what follows" if box.failed else ""
    bad = "are unsafe or cannot be simulated" if box.failed else "are unsafe"
    return (f"{who}: within {box.factor:.1%} of the domain around the original, none of {box.samples} settings drawn at random is unsafe"
            f"{failed}. With {box.confidence:.0%} confidence at most {box.unsafe_at_most:.2%} of all settings in there {bad}.")


def _alone(told: Tolerance) -> WholeTable:
    table = WholeTable("characteristic", title="Each alone", title_justify="left")
    failing = any(one.not_simulated for one in told.alone)
    for head in ("original", "safe from", "to", "SD at the ends", "unsafe", *(["could not be simulated"] if failing else [])):
        table.add_column(head, justify="right")
    for one in told.alone:
        member = one.characteristic
        table.add_row(escape(f"{member.name} [{member.unit}]"), f"{member.original:g}", *_ends(one),
                      *(", ".join(f"{low:.5g} to {high:.5g}" for low, high in intervals) or "nowhere"
                        for intervals in (one.unsafe, *([one.not_simulated] if failing else []))))
    return table


def _ends(one: OneAtATimeScan) -> tuple[str, str, str]:
    if one.safe is None:
        return "nowhere", "nowhere", "-"
    low, high = (_end(one.characteristic, value) for value in one.safe)
    return low, high, " / ".join("-" if degree is None else f"{degree:.2f}" for degree in one.margins)


def _end(member: Characteristic, value: float) -> str:
    """A value with its distance from the original; a star at the end of the domain."""
    at_end = "*" if value in (member.lower, member.upper) else ""
    return f"{value:.5g} ({(value - member.original) / abs(member.original):+.1%}){at_end}"


def _print_pairs(console: Console, told: Tolerance) -> None:
    found = sorted((pair for pair in told.pairs or [] if pair.nearest is not None), key=lambda pair: -pair.unsafe_share)
    if not found:
        return
    table = WholeTable("pair", title=f"Pairs with unsafe settings: {len(found)} of {len(told.pairs or [])}", title_justify="left")
    for head in ("unsafe share", "nearest unsafe setting"):
        table.add_column(head, justify="right")
    for pair in found[:PAIRS_SHOWN]:
        names = [member.name for member in pair.characteristics]
        nearest = ", ".join(f"{name} {value:.5g}" for name, value in zip(names, pair.nearest or (), strict=True))
        failed = f" ({pair.not_simulated_share:.1%} could not be simulated)" if pair.not_simulated_share else ""
        table.add_row(escape(" with ".join(names)), f"{pair.unsafe_share:.1%}{failed}", escape(nearest))
    console.print(table)
    if len(found) > PAIRS_SHOWN:
        _say(console, f"... and {len(found) - PAIRS_SHOWN} more (--json has all).")


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)
