"""Pictures of the answers, readable in print and for colour-blind readers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.analysis.explain.result import Explained
from safevar_sumo.analysis.risk.compute import Risk
from safevar_sumo.analysis.tolerance.compute import Tolerance
from safevar_sumo.analysis.tolerance.one_at_a_time import OneAtATimeScan
from safevar_sumo.analysis.tolerance.pairs import Pair
from safevar_sumo.errors import InputError
from safevar_sumo.study import SAFETY_DEGREE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

DPI = 200
FONT = 8
DEGREE = "safety degree [m]\n(below 0: minus the collision's speed [m/s])"
UNSAFE = "#d55e00"
CHANGED, INVOLVED, NECESSARY = "#bbbbbb", "#56b4e9", "#0072b2"
"""Grey and Okabe and Ito's blues: of different lightness, so that they stay apart without colour."""


def necessity_figure(told: Explained) -> Figure:
    """How often each characteristic is necessary, beside how often it is changed (RQ3.2 asked again)."""
    frame = told.necessity.iloc[::-1]
    figure, ((axis,),) = new_figure(f"{told.study.name}: changed is not needed", 1, 1, (6.4, 1.4 + 0.3 * max(len(frame), 4)))
    names = [plain(name) for name in frame["characteristic"]]
    for column, label, colour, height in (
            ("changed", "changed", CHANGED, 0.8), ("involved", "in some minimal cause", INVOLVED, 0.5),
            ("necessary", "necessary: in every minimal cause", NECESSARY, 0.24)):
        axis.barh(names, 100 * frame[column], height=height, color=colour, label=label)
    axis.set_xlim(0, 100)
    axis.set_xlabel(f"share of {told.analysed} failures [%]")
    axis.grid(visible=False, axis="y")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=FONT)
    return figure


def profiles_figure(told: Tolerance) -> Figure:
    """The safety degree over the domain of each characteristic alone; the original marked, what is unsafe shaded."""
    columns = min(4, len(told.alone))
    rows = -(-len(told.alone) // columns)
    title = f"{told.study.name}: one characteristic at a time (unsafe: {told.unsafe})"
    figure, axes = new_figure(title, rows, columns, (max(2.3 * columns, 4.6), 1.0 + 1.75 * rows))
    degrees = np.concatenate([one.profile[SAFETY_DEGREE].dropna() for one in told.alone])
    margin = 0.05 * (np.ptp(degrees) if degrees.size else 0.0) or 0.5
    for axis, one in zip(axes.flat, told.alone, strict=False):
        _profile(axis, one)
        if degrees.size:
            axis.set_ylim(degrees.min() - margin, degrees.max() + margin)  # the same for all: a steep one is one that matters
    for axis in list(axes.flat)[len(told.alone):]:
        axis.set_axis_off()
    figure.supylabel(DEGREE, fontsize=FONT)
    told_of = {"dot: the original vehicle": True, "hatched: unsafe": any(one.unsafe for one in told.alone),
               "below the dashed line: collisions": bool(degrees.size) and degrees.min() <= 0}
    figure.supxlabel(";\n".join(words for words, is_drawn in told_of.items() if is_drawn), fontsize=FONT)
    return figure


def _profile(axis: Axes, one: OneAtATimeScan) -> None:
    member, profile = one.characteristic, one.profile
    axis.plot(profile["value"], profile[SAFETY_DEGREE], color=NECESSARY, linewidth=1.2)
    for low, high in one.unsafe:
        axis.axvspan(low, high, facecolor=UNSAFE, alpha=0.35, hatch="////", edgecolor="white", linewidth=0)
    at_original = profile.loc[profile["value"] == member.original, SAFETY_DEGREE]
    axis.plot([member.original], at_original, marker="o", color="black", markersize=4)
    if profile[SAFETY_DEGREE].min() <= 0:
        axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlim(member.lower, member.upper)
    axis.set_title(plain(member.name), fontsize=FONT)
    axis.set_xlabel(f"[{raised(member.unit)}]")
    axis.locator_params(axis="x", nbins=4)


def pairs_figure(told: Tolerance, most: int = 6) -> Figure:
    """The planes of the worst pairs: those with the largest unsafe share, or the least safety degree where nothing is unsafe.

    Raises
    ------
    InputError
        If pairs were not looked at.
    """
    if not told.pairs:
        raise InputError("pairs", "there is no pair to draw", "at least two characteristics, looked at in pairs")
    worst = sorted(told.pairs, key=lambda pair: (-pair.unsafe_share, np.nanmin(pair.safety_degree)))[:most]
    degrees = np.concatenate([pair.safety_degree.ravel() for pair in worst])
    columns = min(3, len(worst))
    rows = -(-len(worst) // columns)
    title = f"{told.study.name}: the worst pairs (unsafe: {told.unsafe})"
    figure, axes = new_figure(title, rows, columns, (max(3.0 * columns, 4.6), 1.1 + 2.4 * rows))
    for axis, pair in zip(axes.flat, worst, strict=False):
        colours = _plane(axis, pair, (float(np.nanmin(degrees)), float(np.nanmax(degrees))))
    for axis in list(axes.flat)[len(worst):]:
        axis.set_axis_off()
    bar = figure.colorbar(colours, ax=axes, shrink=0.9)
    bar.set_label(DEGREE, fontsize=FONT)
    bar.ax.tick_params(labelsize=FONT)
    figure.supxlabel("dot: the original vehicle; hatched: unsafe;\ncross: the unsafe setting nearest to the original", fontsize=FONT)
    return figure


def _plane(axis: Axes, pair: Pair, limits: tuple[float, float]) -> QuadMesh:
    """One plane, the first characteristic across."""
    first, second = pair.characteristics
    colours = axis.pcolormesh(*pair.values, pair.safety_degree.T, cmap="cividis", vmin=limits[0], vmax=limits[1], shading="nearest")
    if pair.unsafe.any():
        axis.contourf(*pair.values, pair.unsafe.T.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])
        axis.contour(*pair.values, pair.unsafe.T.astype(float), levels=[0.5], colors=UNSAFE, linewidths=1.2)
    axis.plot(first.original, second.original, marker="o", color="white", markeredgecolor="black", markersize=5)
    if pair.nearest is not None:
        axis.plot(*pair.nearest, marker="X", color=UNSAFE, markeredgecolor="white", markersize=7)
    axis.set_xlabel(f"{plain(first.name)} [{raised(first.unit)}]")
    axis.set_ylabel(f"{plain(second.name)} [{raised(second.unit)}]")
    axis.set_xlim(first.lower, first.upper)
    axis.set_ylim(second.lower, second.upper)
    axis.grid(visible=False)
    return colours


def sensitivity_figure(told: Risk) -> Figure:
    """First-order and total Sobol indices of every characteristic with their intervals, of the safety degree and of being unsafe.

    Raises
    ------
    InputError
        If there are none, because characteristics are correlated.
    """
    if told.sensitivity is None or told.sensitivity_of_unsafe is None:
        raise InputError("correlations", "there are no sensitivity indices of correlated characteristics", "a study without correlations")
    names = told.sensitivity.sort_values("total", kind="stable")["characteristic"].to_list()
    title = f"{told.study.name}: what decides ({told.confidence:.0%} intervals)"
    figure, (axes,) = new_figure(title, 1, 2, (7.2, 1.5 + 0.28 * max(len(names), 4)))
    of_what = {"safety degree": told.sensitivity, f"unsafe ({told.unsafe})": told.sensitivity_of_unsafe}
    for axis, (what, frame) in zip(axes, of_what.items(), strict=True):
        rows = frame.set_index("characteristic").loc[names]
        for column, label, colour, shift in (("total", "total: with all others", CHANGED, 0.2), ("first_order", "alone", NECESSARY, -0.2)):
            width = (rows[f"{column}_upper"] - rows[column]).clip(lower=0)
            axis.barh(np.arange(len(names)) + shift, rows[column], height=0.36, color=colour, xerr=width, label=label,
                      error_kw={"elinewidth": 0.8, "ecolor": "black"})
        axis.set_yticks(np.arange(len(names)), [plain(name) for name in names])
        axis.set_title(plain(what), fontsize=FONT)
        axis.set_xlabel("share of the variance [-]")
        axis.set_xlim(0, 1)
        if rows["total"].isna().all():
            axis.text(0.5, 0.5, "too few settings are unsafe,\nor safe, to tell", transform=axis.transAxes, ha="center", fontsize=FONT)
        axis.grid(visible=False, axis="y")
    axes[1].set_yticklabels([])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=FONT)
    return figure


def new_figure(title: str, rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, np.ndarray]:
    """A figure that no global state knows of, and its axes, shape (rows, columns); `size` in inches."""
    import matplotlib.style
    from matplotlib.figure import Figure

    with matplotlib.style.context(["seaborn-v0_8-whitegrid", {"font.size": FONT, "axes.labelsize": FONT, "axes.titlesize": FONT,
                                                              "xtick.labelsize": FONT, "ytick.labelsize": FONT}]):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(plain(title), fontsize=FONT + 2)
    return figure, axes


def save(figure: Figure, path: Path, source: str = "out") -> None:
    """Write a figure to a file: png, pdf or svg.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        figure.savefig(path, dpi=DPI)
    except OSError as error:
        raise InputError(source, f"cannot write {path}: {error.strerror or error}", "a directory that can be written") from None


def plain(name: str) -> str:
    """A name in which matplotlib sees no formula."""
    return name.replace("$", r"\$")


def raised(unit: str) -> str:
    """A unit with its powers raised."""
    return re.sub(r"\^(-?\d+)", r"$^{\1}$", plain(unit))
