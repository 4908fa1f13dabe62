"""The answer on tolerances: how far characteristics may go, as JSON, table, sentences and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

import pandas as pd
from rich.table import Table

from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.evaluator import CONFIDENCE
from safevar_sumo.questions.figures import (
    BLUE,
    DEGREE_LABEL,
    FONT_SIZE,
    VERMILION,
    as_formula,
    escape_dollars,
    new_panels,
)
from safevar_sumo.questions.tolerance.joint import JointLimits
from safevar_sumo.questions.tolerance.scans import WHOLE_POINT_LOSS, OneAtATimeScan
from safevar_sumo.questions.tolerance.sheet import LimitRow, LimitsSheet
from safevar_sumo.questions.words import two_decimals
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.study import SAFETY_DEGREE, Limit, Study
from safevar_sumo.sumo.empty_road import driven_entry
from safevar_sumo.terminal import WholeTable, answer_as_html, constraints_in_words, meanings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far characteristics may go: each alone, and all together.

    Attributes
    ----------
    original
        The evaluation of the original vehicle.
    alone
        A scan of each characteristic.
    together
        The largest safe box, in which the specified limits are reached; None if no box was sought: of a rated study, or
        around an unsafe original.
    no_verdict
        Why simulations tell nothing about the driving system; "" if they do.
    limits
        The limits that the user specified, by characteristic.
    beyond, beyond_alone
        What fails first beyond a characteristic's limit, by its name: with the others at their limits, and alone.
    """

    study: Study
    unsafe: Unsafe
    original: Evaluations
    alone: list[OneAtATimeScan]
    together: JointLimits | None
    no_verdict: str
    limits: Mapping[str, Limit]
    beyond: Mapping[str, str]
    beyond_alone: Mapping[str, str]

    @property
    def box(self) -> JointLimits | None:
        """The box if it is safe."""
        return self.together if self.together is not None and self.together.kept else None

    @property
    def sheet(self) -> LimitsSheet:
        """The limits sheet."""
        rows = [
            LimitRow(
                scan=scan,
                together=None if self.box is None else self.box.box[scan.characteristic.name],
                is_sought=not is_rated(self.study),
                specified=self.limits.get(scan.characteristic.name),
                beyond=self.beyond.get(scan.characteristic.name, ""),
                beyond_alone=self.beyond_alone.get(scan.characteristic.name, ""),
            )
            for scan in self.alone
        ]
        return LimitsSheet(self.study.name, rows)

    @property
    def broken_limits(self) -> list[str]:
        """A sentence for each limit that is not kept."""
        return [f"limit of {row.characteristic.name}: {row.verdict}" for row in self.sheet.rows if not row.kept]

    @property
    def verdict(self) -> str:
        """One sentence on the characteristics that are unsafe alone."""
        if self.no_verdict:
            return self.no_verdict
        if self.unsafe.of(self.original)[0]:
            return "The original vehicle itself is unsafe."
        if names := [scan.characteristic.name for scan in self.alone if scan.unsafe]:
            return f"Unsafe alone, all others as in the original: {', '.join(names)}."
        return "No single characteristic makes it unsafe."

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

    def to_dict(self) -> JsonObject:
        """The JSON of `tolerance`: the criterion, the test of the limits together, each alone, and the limits."""
        box = self.together
        return {
            "study": self.study.name,
            **driven_entry(self.no_verdict),
            "unsafe": str(self.unsafe),
            "margin": self.unsafe.keep,
            "kept": not self.broken_limits,
            "samples": None if box is None else box.samples,
            "failures": None if box is None else box.unsafe,
            "at_most": None if box is None else box.at_most,
            "alone": [scan.to_dict() for scan in self.alone],
            "limits": [row.to_dict() for row in self.sheet.rows],
        }

    _repr_html_ = answer_as_html

    def __repr__(self) -> str:
        return f"<Tolerance of {self.study.name}, unsafe {self.unsafe}: {self.verdict}>"

    def sentences(self) -> Iterator[str | Table]:
        """The verdict, the limits that may be obeyed together with the test of them, and each characteristic alone."""
        yield f"Unsafe: {self.unsafe.description}."
        if not self.no_verdict:
            yield self.verdict
        yield from constraints_in_words(self.study)
        yield from self.sheet.parts()
        if not is_rated(self.study):
            yield self._box_in_words()
        yield _scan_table(self.alone, self.unsafe.contact)
        yield "* the end of the domain: values beyond it were not simulated."
        yield meanings(scan.characteristic for scan in self.alone)
        yield from _across_fits_in_words(self.alone)
        if is_rated(self.study):
            yield from map(_losses_in_words, self.alone)

    def _box_in_words(self) -> str:
        """The result of the test of the box."""
        box = self.together
        if box is None or not (box.kept or self.limits):
            return "No box around the original is safe."
        failed = f", and {box.failed} could not be simulated" if box.failed else ""
        of_all = " of all that satisfy the constraints" if self.study.constraints else " of all"
        bound = f"with {100 * CONFIDENCE:.0f} % confidence at most {100 * box.at_most:.2f} %{of_all} are"
        if not box.kept:
            drawn = f"{box.unsafe} of {box.samples} settings drawn at random"
            return (
                f"The limits are not kept: {drawn if box.unsafe else 'settings that a search found'} within them, all "
                f"other characteristics as in the original, are unsafe{failed}; {bound}."
            )
        return (
            "The limits together are the largest box by volume that was found. None of its corners, and none of "
            f"{box.samples} settings drawn at random in it, is unsafe{failed}; {bound}."
        )

    def figure(self) -> Figure:
        """The safety degree, or points, over each domain; the original is marked, unsafe intervals are shaded."""
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


def _scan_table(scans: Sequence[OneAtATimeScan], contact: float) -> WholeTable:
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
            if contact:
                gaps = [None if degree is None else degree - contact for degree in scan.margins]
                cells[-1] += f" (gap {' / '.join(map(two_decimals, gaps))})"
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
