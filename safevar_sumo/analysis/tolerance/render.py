"""How far characteristics may go, as text on the terminal and as figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from safevar_sumo.analysis.figures import BLUE, DEGREE_LABEL, FONT, VERMILION, as_formula, escape_dollars, new_panels
from safevar_sumo.analysis.tolerance.compute import WHOLE_POINT_LOSS, OneAtATimeScan, Tolerance
from safevar_sumo.analysis.tolerance.pairs import Pair
from safevar_sumo.analysis.words import two_decimals
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.terminal import WholeTable, print_constraints, print_heading, print_meanings, print_text
from safevar_sumo.vehicles import Characteristic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

MAX_PAIRS = 12


def print_tolerance(console: Console, result: Tolerance) -> None:
    """Print the verdict, the limits of each characteristic by itself, the worst pairs, and the safe box."""
    print_heading(console, result.study.title, result.no_verdict)
    original = result.original
    print_text(console, f"Unsafe: {result.unsafe.description}. The original vehicle: {original.outcome[0]}, "
                        f"SD {two_decimals(original.f_safe[0])}.")
    if not result.no_verdict:
        print_text(console, result.verdict)
    print_constraints(console, result.study)
    console.print(_scan_table(result))
    print_text(console, "* the end of the domain: values beyond it were not simulated.")
    print_meanings(console, [scan.characteristic for scan in result.alone])
    if result.pairs:
        _print_pairs(console, result)
    if is_rated(result.study):
        for scan in result.alone:
            print_text(console, first_losses_in_words(scan))
    else:
        print_text(console, _box_in_words(result))


def first_losses_in_words(scan: OneAtATimeScan) -> str:
    """A sentence on the values at which a characteristic alone costs points."""
    characteristic, any_loss, whole_point = scan.characteristic, scan.first_loss(), scan.first_loss(WHOLE_POINT_LOSS)
    if any_loss is None:
        return f"{characteristic.name}: costs no points anywhere in its domain."
    least = min(kept for _, kept in scan.points or [])
    first = ("; it never costs a whole point" if whole_point is None else
             f"; the first point is lost at {whole_point:.5g}{characteristic.suffix}")
    start = f"{characteristic.name}: points are lost from {any_loss:.5g}{characteristic.suffix} on"
    return f"{start}{first}; the minimum is {least:.2f} points."


def _box_in_words(result: Tolerance) -> str:
    box = result.joint
    subset = len(box.characteristics) < len(result.study.vehicle.characteristics)
    subject = f"{', '.join(box.characteristics)} together, the others as in the original" if subset else "All together"
    if not box.factor:
        return f"{subject}: no box around the original is safe."
    failed = f"; {box.failed} of them could not be simulated and count as unsafe in what follows" if box.failed else ""
    box_settings = "all settings in the box that satisfy the constraints" if result.study.constraints else "all settings in the box"
    predicate = "are unsafe or cannot be simulated" if box.failed else "are unsafe"
    return (f"{subject}: each may go {100 * box.factor:.1f} % of the way from its original value to either end of its domain. None of "
            f"{box.samples} settings drawn at random in this box is unsafe{failed}. With {100 * box.confidence:.0f} % confidence at most "
            f"{100 * box.unsafe_at_most:.2f} % of {box_settings} {predicate}.")


def _scan_table(result: Tolerance) -> WholeTable:
    intervals_by_header = {"could not be simulated": [scan.not_simulated for scan in result.alone],
                           "violates a constraint": [scan.infeasible for scan in result.alone]}
    intervals_by_header = {header: intervals for header, intervals in intervals_by_header.items() if any(intervals)}
    headers = ("original", "safe from", "to", "SD at the ends", "unsafe", *intervals_by_header)
    table = WholeTable("characteristic", right=headers, title="Each alone, all others as in the original")
    for index, scan in enumerate(result.alone):
        characteristic = scan.characteristic
        table.add_row(f"{characteristic.name} [{characteristic.unit}]", f"{characteristic.original:g}", *_limits_in_words(scan),
                      *(", ".join(f"{low:.5g} to {high:.5g}" for low, high in intervals) or "nowhere"
                        for intervals in (scan.unsafe, *(column[index] for column in intervals_by_header.values()))))
    return table


def _limits_in_words(scan: OneAtATimeScan) -> tuple[str, str, str]:
    if scan.safe is None:
        return "nowhere", "nowhere", "-"
    low, high = (_limit_in_words(scan.characteristic, value) for value in scan.safe)
    return low, high, " / ".join(map(two_decimals, scan.margins))


def _limit_in_words(characteristic: Characteristic, value: float) -> str:
    """A value with its change from the original, and a star if it is an end of the domain."""
    at_end = "*" if value in (characteristic.lower, characteristic.upper) else ""
    return f"{value:.5g} ({(value - characteristic.original) / abs(characteristic.original):+.1%}){at_end}"


def _print_pairs(console: Console, result: Tolerance) -> None:
    unsafe_pairs = sorted((pair for pair in result.pairs or [] if pair.nearest is not None), key=lambda pair: -pair.unsafe_share)
    if not unsafe_pairs:
        return
    table = WholeTable("pair", right=("unsafe share", "nearest unsafe setting"),
                       title=f"Pairs with unsafe settings: {len(unsafe_pairs)} of {len(result.pairs or [])}")
    for pair in unsafe_pairs[:MAX_PAIRS]:
        names = [characteristic.name for characteristic in pair.characteristics]
        nearest = ", ".join(f"{name} {value:.5g}" for name, value in zip(names, pair.nearest or (), strict=True))
        failed = f" ({100 * pair.not_simulated_share:.1f} % could not be simulated)" if pair.not_simulated_share else ""
        table.add_row(" with ".join(names), f"{100 * pair.unsafe_share:.1f} %{failed}", nearest)
    console.print(table)
    if len(unsafe_pairs) > MAX_PAIRS:
        print_text(console, f"... and {len(unsafe_pairs) - MAX_PAIRS} more (--json has all).")


def profiles_figure(result: Tolerance) -> Figure:
    """The safety degree over the domain of each characteristic alone; the original is marked, unsafe intervals are shaded."""
    title, column = f"{result.study.name}: one characteristic at a time (unsafe: {result.unsafe})", _profile_column(result)
    figure, axes = new_panels(title, len(result.alone), 4, (2.3, 1.75), min_width=4.6, title_height=1.0)
    degrees = np.concatenate([scan.profile[column].dropna() for scan in result.alone])
    margin = 0.05 * (np.ptp(degrees) if degrees.size else 0.0) or 0.5
    for axis, scan in zip(axes, result.alone, strict=True):
        _draw_profile(axis, scan, column)
        if degrees.size:
            axis.set_ylim(degrees.min() - margin, degrees.max() + margin)  # equal for all panels, so that steep profiles stand out
    figure.supylabel(DEGREE_LABEL if column == SAFETY_DEGREE else RATING_POINTS.title, fontsize=FONT)
    notes = {"dot: the original vehicle": True, "hatched: unsafe": any(scan.unsafe for scan in result.alone),
             "below the dashed line: collisions": column == SAFETY_DEGREE and bool(degrees.size) and degrees.min() <= 0}
    figure.supxlabel(";\n".join(words for words, is_drawn in notes.items() if is_drawn), fontsize=FONT)
    return figure


def _profile_column(result: Tolerance) -> str:
    """The column that the profiles show."""
    return RATING_POINTS.name if is_rated(result.study) else SAFETY_DEGREE


def _draw_profile(axis: Axes, scan: OneAtATimeScan, column: str) -> None:
    characteristic, profile = scan.characteristic, scan.profile
    axis.plot(profile["value"], profile[column], color=BLUE, linewidth=1.2)
    for low, high in scan.unsafe:
        axis.axvspan(low, high, facecolor=VERMILION, alpha=0.35, hatch="////", edgecolor="white", linewidth=0)
    at_original = profile.loc[profile["value"] == characteristic.original, column]
    axis.plot([characteristic.original], at_original, marker="o", color="black", markersize=4)
    if column == SAFETY_DEGREE and profile[SAFETY_DEGREE].min() <= 0:
        axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlim(characteristic.lower, characteristic.upper)
    axis.set_title(escape_dollars(characteristic.name), fontsize=FONT)
    axis.set_xlabel(f"[{as_formula(characteristic.unit)}]")
    axis.locator_params(axis="x", nbins=4)


MAX_PAIRS_DRAWN = 6
"""Maximum number of pairs in the figure."""


def pairs_figure(result: Tolerance) -> Figure:
    """The planes of the worst pairs: with the largest unsafe share, or the lowest safety degree where nothing is unsafe.

    Raises
    ------
    InputError
        If the result has no pairs.
    """
    if not result.pairs:
        raise InputError("pairs", "there is no pair to draw", "at least two characteristics, evaluated in pairs")
    worst = sorted(result.pairs, key=lambda pair: (-pair.unsafe_share, np.nanmin(pair.safety_degree)))[:MAX_PAIRS_DRAWN]
    degrees = np.concatenate([pair.safety_degree.ravel() for pair in worst])
    title = f"{result.study.name}: the worst pairs (unsafe: {result.unsafe})"
    figure, axes = new_panels(title, len(worst), 3, (3.0, 2.4), min_width=4.6, title_height=1.1)
    for axis, pair in zip(axes, worst, strict=True):
        colours = _draw_plane(axis, pair, (float(np.nanmin(degrees)), float(np.nanmax(degrees))))
    bar = figure.colorbar(colours, ax=figure.axes, shrink=0.9)
    bar.set_label(DEGREE_LABEL, fontsize=FONT)
    bar.ax.tick_params(labelsize=FONT)
    figure.supxlabel("dot: the original vehicle; hatched: unsafe;\ncross: the unsafe setting nearest to the original", fontsize=FONT)
    return figure


def _draw_plane(axis: Axes, pair: Pair, limits: tuple[float, float]) -> QuadMesh:
    """Draw one plane, with the first characteristic on the horizontal axis."""
    first, second = pair.characteristics
    colours = axis.pcolormesh(*pair.values, pair.safety_degree.T, cmap="cividis", vmin=limits[0], vmax=limits[1], shading="nearest")
    if pair.unsafe.any():
        axis.contourf(*pair.values, pair.unsafe.T.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])
        axis.contour(*pair.values, pair.unsafe.T.astype(float), levels=[0.5], colors=VERMILION, linewidths=1.2)
    axis.plot(first.original, second.original, marker="o", color="white", markeredgecolor="black", markersize=5)
    if pair.nearest is not None:
        axis.plot(*pair.nearest, marker="X", color=VERMILION, markeredgecolor="white", markersize=7)
    axis.set_xlabel(f"{escape_dollars(first.name)} [{as_formula(first.unit)}]")
    axis.set_ylabel(f"{escape_dollars(second.name)} [{as_formula(second.unit)}]")
    axis.set_xlim(first.lower, first.upper)
    axis.set_ylim(second.lower, second.upper)
    axis.grid(visible=False)
    return colours
