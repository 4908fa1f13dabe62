"""The answer on tolerances: how far characteristics may go, as JSON, table, sentences and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING

import pandas as pd
from rich.table import Table

from safevar_sumo.analysis.explain.answer import situation_in_words
from safevar_sumo.analysis.figures import (
    BLUE,
    DEGREE_LABEL,
    FONT_SIZE,
    VERMILION,
    as_formula,
    escape_dollars,
    new_panels,
)
from safevar_sumo.analysis.tolerance.boxes import SafeBox
from safevar_sumo.analysis.tolerance.joint import JointLimits
from safevar_sumo.analysis.tolerance.scans import WHOLE_POINT_LOSS, OneAtATimeScan, Pair
from safevar_sumo.analysis.tolerance.sheet import LimitRow, LimitsSheet, describe_failure
from safevar_sumo.analysis.tolerance.trade import Trade
from safevar_sumo.analysis.words import two_decimals
from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.study import SAFETY_DEGREE, Limit, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, answer_as_html, constraints_in_words, meanings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PAIRS = 12
"""Maximum number of pairs in the table."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far characteristics may go: each by itself, two together, and all together.

    Attributes
    ----------
    original
        The evaluation of the original vehicle.
    alone
        A scan of each characteristic.
    pairs
        The planes of two characteristics; None if not requested.
    joint
        The largest safe box that is the same share of every domain.
    no_verdict
        Why simulations tell nothing about the driving system; "" if they do.
    limits
        The limits that the user specified, by characteristic.
    together
        The largest safe box in which the limits are reached; None without limits, and if no box is sought.
    first_failures
        Evaluations of what fails first beyond the limit of a characteristic, by name.
    trade
        The trade-off of two characteristics; None if not requested.
    """

    study: Study
    unsafe: Unsafe
    original: Evaluations
    alone: list[OneAtATimeScan]
    pairs: list[Pair] | None
    joint: SafeBox
    no_verdict: str = ""
    limits: Mapping[str, Limit] = field(default_factory=dict)
    together: JointLimits | None = None
    first_failures: Mapping[str, Evaluations] = field(default_factory=dict)
    trade: Trade | None = None

    @property
    def sheet(self) -> LimitsSheet:
        """The limits sheet: all together are in the box with the specified limits, else in the proportional box."""
        rows, factor, points = [], self.joint.factor, assemble(self.study).points
        for scan in self.alone:
            item = scan.characteristic
            run = self.first_failures.get(item.name)
            interval = None
            if self.together is not None:
                interval = self.together.box[item.name]
            elif factor:
                interval = (
                    item.original - factor * (item.original - item.lower),
                    item.original + factor * (item.upper - item.original),
                )
            rows.append(
                LimitRow(
                    scan=scan,
                    together=interval,
                    specified=self.limits.get(item.name),
                    together_is_safe=self.together is None or self.together.kept,
                    first_failure=None if run is None else describe_failure(run, points, self.unsafe),
                )
            )
        return LimitsSheet(self.study.name, rows)

    @property
    def broken_limits(self) -> list[str]:
        """A sentence for each limit that is not kept."""
        return [f"limit of {row.characteristic.name}: {row.verdict}" for row in self.sheet.rows if not row.kept]

    @property
    def unsafe_pairs(self) -> list[Pair]:
        return [pair for pair in self.pairs or [] if pair.nearest is not None]

    @property
    def verdict(self) -> str:
        """One sentence on the characteristics and pairs that are unsafe by themselves."""
        if self.no_verdict:
            return self.no_verdict
        if self.unsafe.of(self.original)[0]:
            return "The original vehicle itself is unsafe."
        if names := [scan.characteristic.name for scan in self.alone if scan.unsafe]:
            return f"Unsafe alone, all others as in the original: {', '.join(names)}."
        if pairs := [" with ".join(pair.characteristics) for pair in self.unsafe_pairs]:
            number = f"{len(pairs)} of {len(self.pairs or [])} pairs"
            return f"No single characteristic makes it unsafe, but {number}: {', '.join(pairs)}."
        return f"No single characteristic {'makes' if self.pairs is None else 'and no pair makes'} it unsafe."

    def to_frame(self) -> pd.DataFrame:
        """One row for each characteristic alone.

        Columns: `characteristic`, `unit`, `original`, `lower` and `upper` of the domain, `safe_from`, `safe_to` [unit],
        `margin_from`, `margin_to`, the safety degrees there [m], and `unsafe` and `not_simulated`, lists of intervals.
        """
        columns = ["characteristic", "unit", "original", "lower", "upper"]
        columns += ["safe_from", "safe_to", "margin_from", "margin_to", "unsafe", "not_simulated"]
        rows = [
            (
                *attrgetter("name", "unit", "original", "lower", "upper")(scan.characteristic),
                *(*(scan.safe or (None, None)), *scan.margins, scan.unsafe, scan.intervals("not_simulated")),
            )
            for scan in self.alone
        ]
        return pd.DataFrame(rows, columns=columns)

    def to_dict(self) -> JsonObject | list[JsonObject]:
        """The JSON of `tolerance`: a record; with limits, a list of it, the limits' records, the box with the limits,
        and the trade-off.
        """
        record = {
            "study": self.study.name,
            **driven_entry(self.no_verdict),
            "unsafe": str(self.unsafe),
            "alone": [scan.to_dict() for scan in self.alone],
            "pairs": [pair._asdict() for pair in self.pairs or []],
            "joint": self.joint._asdict(),
        }
        trade = {} if self.trade is None else {"trade": self.trade.to_dict()}
        if not self.limits:
            return {**record, **trade}
        joint = {"joint": None} if self.together is None else self.together.to_dict()
        return [record, *(row.to_dict() for row in self.sheet.rows), joint, *([trade] if trade else [])]

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        return f"<Tolerance of {self.study.name}, unsafe {self.unsafe}: {self.verdict}>"

    def sentences(self) -> Iterator[str | Table]:
        """The verdict, the limits of each characteristic by itself, the worst pairs, and the safe box."""
        yield f"Unsafe: {self.unsafe.description}. {situation_in_words(assemble(self.study), self.original)}"
        if not self.no_verdict:
            yield self.verdict
        yield from constraints_in_words(self.study)
        yield _scan_table(self.alone)
        yield "* the end of the domain: values beyond it were not simulated."
        yield meanings(scan.characteristic for scan in self.alone)
        yield from _across_fits_in_words(self.alone)
        yield from self._pairs_in_words()
        yield from self.sheet.parts()
        if is_rated(self.study):
            yield from map(_losses_in_words, self.alone)
        else:
            yield self._box_in_words() if self.together is None else self.together.in_words
        if self.trade is not None:
            yield self.trade.table() if self.trade.curve else f"{self.trade.title}."

    def _pairs_in_words(self) -> Iterator[str | Table]:
        worst = sorted(self.unsafe_pairs, key=lambda pair: -pair.unsafe_share)
        title = f"Pairs with unsafe settings: {len(worst)} of {len(self.pairs or [])}"
        table = WholeTable("pair", right=("unsafe share", "nearest unsafe setting"), title=title)
        for pair in worst[:MAX_PAIRS]:
            nearest = ", ".join(f"{name} {value:.5g}" for name, value in (pair.nearest or {}).items())
            share = pair.not_simulated_share
            failed = f" ({100 * share:.1f} % could not be simulated)" if share else ""
            table.add_row(" with ".join(pair.characteristics), f"{100 * pair.unsafe_share:.1f} %{failed}", nearest)
        yield table
        if len(worst) > MAX_PAIRS:
            yield f"... and {len(worst) - MAX_PAIRS} more (--json has all)."

    def _box_in_words(self) -> str:
        box, subject = self.joint, "All together"
        if len(box.characteristics) < len(self.study.vehicle.characteristics):
            subject = f"{', '.join(box.characteristics)} together, the others as in the original"
        if not box.factor:
            return f"{subject}: no box around the original is safe."
        failed, or_failed = "", ""
        if box.failed:
            failed, or_failed = f", and {box.failed} could not be simulated", " or cannot be simulated"
        feasible = " that satisfy the constraints" if self.study.constraints else ""
        return (
            f"{subject}: each may go {100 * box.factor:.1f} % of the way from its original value to either end of its "
            f"domain. None of {box.samples} settings drawn at random in this box is unsafe{failed}. With "
            f"{100 * box.confidence:.0f} % confidence at most {100 * box.unsafe_at_most:.2f} % of all settings in the "
            f"box{feasible} are unsafe{or_failed}."
        )

    def figure(self) -> Figure:
        """The safety degree, or points, over each domain; the original is marked, unsafe intervals are shaded. With a
        trade-off, its curve instead.
        """
        if self.trade is not None:
            return self.trade.figure(self.study.name)
        column = RATING_POINTS.name if is_rated(self.study) else SAFETY_DEGREE
        title = f"{self.study.name}: one characteristic at a time (unsafe: {self.unsafe})"
        figure, axes = new_panels(title, len(self.alone), 4, (2.3, 1.75), min_width=4.6, title_height=1.0)
        for axis, scan in zip(axes, self.alone, strict=True):
            if axis is not axes[0]:
                axis.sharey(axes[0])  # so that steep profiles stand out
            _draw_profile(axis, scan, column)
        figure.supylabel(DEGREE_LABEL if column == SAFETY_DEGREE else RATING_POINTS.title, fontsize=FONT_SIZE)
        dashed = ";\nbelow a dashed line: collisions" if column == SAFETY_DEGREE else ""
        figure.supxlabel(f"dot: the original vehicle; hatched: unsafe{dashed}", fontsize=FONT_SIZE)
        return figure


def _scan_table(scans: Sequence[OneAtATimeScan]) -> WholeTable:
    states = {"unsafe": "unsafe", "not_simulated": "could not be simulated", "infeasible": "violates a constraint"}
    shown = [state for state in states if state == "unsafe" or any(scan.intervals(state) for scan in scans)]
    heads = ("original", "safe from", "to", "SD at the ends", *(states[state] for state in shown))
    table = WholeTable("characteristic", title="Each alone, all others as in the original", right=heads)
    for scan in scans:
        item = scan.characteristic
        cells = ["nowhere", "nowhere", "-"]
        if scan.safe is not None:
            cells = [
                f"{value:.5g} ({(value - item.original) / abs(item.original):+.1%})"
                f"{'*' if value in (item.lower, item.upper) else ''}"
                for value in scan.safe
            ]
            cells.append(" / ".join(map(two_decimals, scan.margins)))
        cells += [", ".join(f"{low:.5g} to {high:.5g}" for low, high in scan.intervals(state)) for state in shown]
        table.add_row(f"{item.name} [{item.unit}]", f"{item.original:g}", *(cell or "nowhere" for cell in cells))
    return table


def _across_fits_in_words(scans: Sequence[OneAtATimeScan]) -> Iterator[str]:
    """How far the ends of the safe intervals depend on the fit; nothing without fits."""
    across_fits = {scan.characteristic: scan.across_fits for scan in scans if scan.across_fits}
    differences = [
        f"the safe interval of {item.name} {verb} {item.text(low)} to {item.text(high)}{item.suffix}"
        for item, ends in across_fits.items()
        for verb, (low, high) in zip(("begins at", "ends at"), ends.range, strict=True)
        if item.text(low) != item.text(high)
    ]
    if across_fits:
        sets = max(ends.sets for ends in across_fits.values())
        fits = f"With {sets} vehicle models that fit the published data about as well,"
        lost = max(ends.unsafe_as_new for ends in across_fits.values())
        differences = differences or ["all safe intervals are the same"]
        if lost:
            differences.append(f"with {lost} more even the original is unsafe")
        yield f"{fits} {'; '.join(differences)}."


def _losses_in_words(scan: OneAtATimeScan) -> str:
    """A sentence on the values from which on a characteristic alone costs points."""
    name, suffix = scan.characteristic.name, scan.characteristic.suffix
    any_loss, whole_point = scan.first_loss(), scan.first_loss(WHOLE_POINT_LOSS)
    if any_loss is None:
        return f"{name}: costs no points anywhere in its domain."
    first = "it never costs a whole point"
    if whole_point is not None:
        first = f"the first point is lost at {whole_point:.5g}{suffix}"
    least = f"the minimum is {min((scan.points or {}).values()):.2f} points"
    return f"{name}: points are lost from {any_loss:.5g}{suffix} on; {first}; {least}."


def _draw_profile(axis: Axes, scan: OneAtATimeScan, column: str) -> None:
    item, profile = scan.characteristic, scan.profile.set_index("value")[column]
    axis.plot(profile, color=BLUE, linewidth=1.2)
    for low, high in scan.unsafe:
        axis.axvspan(low, high, facecolor=VERMILION, alpha=0.35, hatch="////", edgecolor="white", linewidth=0)
    axis.plot(item.original, profile[item.original], marker="o", color="black", markersize=4)
    if column == SAFETY_DEGREE and profile.min() <= 0:
        axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlim(item.lower, item.upper)
    axis.set_title(escape_dollars(item.name), fontsize=FONT_SIZE)
    axis.set_xlabel(f"[{as_formula(item.unit)}]")
    axis.locator_params(axis="x", nbins=4)
