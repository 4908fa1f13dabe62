"""The figure of a comparison: speeds, gaps, pedals and times to collision of both vehicles."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.figures import own_style
from safevar_sumo.records import STANDSTILL, SimulationRuns
from safevar_sumo.replay.comparison import COLOURS, Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BRAKING_MARK = "v"
NEAREST_MARK = "o"
IMPACT_MARK = "X"
LINE_STYLES = ("-", "--")
"""Line styles of the original and of the changed vehicle."""
MAX_TTC = 6.0
"""Largest time to collision that is drawn [s]."""
MIN_DIVERGENCE = 0.1
"""Difference in speed above which two vehicles have diverged [m/s]."""
TRACE_FONT_SIZE = 9
LINE_LENGTH = 118
"""Length of a line of the heading [characters]."""


@checked
@own_style()
def draw_comparison(comparison: Comparison) -> Figure:
    """Draw a comparison as a figure outside any window."""
    import matplotlib.style
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    comparison.refuse_without_position()

    with matplotlib.style.context(
        [
            "seaborn-v0_8-whitegrid",
            {"font.size": TRACE_FONT_SIZE, "axes.labelsize": TRACE_FONT_SIZE},
        ]
    ):
        figure = Figure(
            figsize=(9.6, 6.2), layout=ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.08)
        )
        axes = figure.subplots(2, 2, sharex=True).ravel()

    runs = comparison.runs
    divergence_time = find_divergence(runs)
    trace = runs.trace
    ttc = runs.time_to_collision
    quantities = {
        "speed [m/s]": trace.speed,
        "gap to the obstacle [m]": np.where(np.isfinite(trace.gap), trace.gap, np.nan),
        "brake     |     throttle": trace.throttle - trace.brake,
        "time to collision [s]": np.where(ttc <= MAX_TTC, ttc, np.nan),
    }
    for axis, (label, values) in zip(axes, quantities.items(), strict=True):
        axis.set_ylabel(label)
        for row in comparison.rows:
            end = comparison.moments[row].end + 1
            axis.plot(
                trace.time[:end],
                values[:end, row],
                color=COLOURS[row],
                linestyle=LINE_STYLES[row],
                linewidth=1.6,
                zorder=3 + row,
            )
        if divergence_time is not None:
            axis.axvline(
                divergence_time, color="0.35", linewidth=0.9, linestyle="-.", zorder=1
            )

    speed_axis, gap_axis, pedal_axis, ttc_axis = axes
    for row in comparison.rows:
        _mark_moments(speed_axis, gap_axis, comparison, row)
    speed_axis.margins(y=0.1)
    gap_axis.axhline(0, color="black", linewidth=0.8)
    gap_axis.set_ylim(-0.22 * gap_axis.get_ylim()[1], None)
    pedal_axis.set(ylim=(-1.08, 1.08), xlabel="time [s]")
    pedal_axis.set_yticks([-1, -0.5, 0, 0.5, 1], ["1", "0.5", "0", "0.5", "1"])
    ttc_axis.set(
        ylim=(0, None), xlim=(None, _end_time(comparison) * 1.25), xlabel="time [s]"
    )
    ttc_axis.axhline(
        comparison.system.metrics_table.ttc_threshold,
        color="0.4",
        linewidth=0.9,
        linestyle=":",
    )
    figure.suptitle(
        _heading(comparison).replace("$", r"\$"), fontsize=TRACE_FONT_SIZE + 1
    )
    _draw_legend(figure, comparison, divergence_time)
    return figure


def _mark_moments(
    speed_axis: Axes, gap_axis: Axes, comparison: Comparison, row: int
) -> None:
    """Mark the moments at which a vehicle begins to brake, is nearest to the obstacle, and
    collides. Marks of the original are larger: they show behind marks of the changed vehicle.
    """
    trace = comparison.runs.trace
    start, nearest, end = comparison.moments[row]
    impact_speed = float(comparison.runs.collision_speed[row])
    has_impact = not np.isnan(impact_speed)

    def draw(
        axis: Axes, sample: int, value: float, mark: str, text: str = "", **place: Any
    ) -> None:
        point = (trace.time[sample], value)
        colour = COLOURS[row]
        size = 12 - 4 * row
        if mark == IMPACT_MARK:
            size += 2
        axis.plot(
            *point,
            mark,
            color=colour,
            markersize=size,
            linestyle="",
            zorder=6 + row,
            markeredgecolor="white",
        )
        axis.annotate(
            text,
            point,
            textcoords="offset points",
            color=colour,
            fontweight="bold",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
            zorder=5,
            **place,
        )

    if start is not None:
        draw(speed_axis, start, trace.speed[start, row], BRAKING_MARK, xytext=(0, 0))
    if has_impact:
        draw(
            speed_axis,
            end,
            impact_speed,
            IMPACT_MARK,
            f"{impact_speed:.1f} m/s",
            xytext=(3, 7),
            ha="left",
        )
    if nearest is not None and np.isfinite(trace.gap[nearest, row]):
        gap = trace.gap[nearest, row]
        least_gaps = np.where(trace.active, trace.gap, np.inf).min(axis=0)
        is_largest = np.argmax(least_gaps) == row
        draw(
            gap_axis,
            nearest,
            gap,
            IMPACT_MARK if has_impact else NEAREST_MARK,
            "impact" if has_impact else f"{gap:.2f} m",
            xytext=(0, 9 if is_largest else -17),
            ha="center",
        )


def _end_time(comparison: Comparison) -> float:
    """The end of the time axis [s]: a sample after all vehicles are at rest (or their runs have
    ended), and after both nearest moments.
    """
    runs = comparison.runs
    last_moving = np.flatnonzero(
        (runs.trace.active & (runs.trace.speed > STANDSTILL)).any(axis=1)
    ).max(initial=0)
    last_sample = max(
        last_moving, *(moments.nearest or 0 for moments in comparison.moments)
    )
    return float(runs.trace.time[min(last_sample + 1, len(runs.trace.time) - 1)])


def _draw_legend(
    figure: Figure, comparison: Comparison, divergence_time: float | None
) -> None:
    """Draw the legend: vehicles, marks, and lines."""
    from matplotlib.lines import Line2D

    handles = []

    def add(label: str, **style: Any) -> None:
        handles.append(Line2D([], [], label=label, **{"color": "0.35", **style}))

    for row in comparison.rows:
        label = f"{comparison.name(row)} vehicle: {comparison.verdict(row)}"
        add(label, color=COLOURS[row], linestyle=LINE_STYLES[row])
    marks = {"begins to brake": BRAKING_MARK, "nearest": NEAREST_MARK}
    if np.isfinite(comparison.runs.collision_speed).any():
        marks["impact"] = IMPACT_MARK
    for label, mark in marks.items():
        add(label, marker=mark, linestyle="", markersize=7)
    if divergence_time is not None:
        add("speeds diverge (by 0.1 m/s)", linestyle="-.", linewidth=0.9)
    threshold = (
        f"TTC* = {comparison.system.metrics_table.ttc_threshold:g} s: critical below"
    )
    add(threshold, color="0.4", linestyle=":", linewidth=0.9)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)


def find_divergence(runs: SimulationRuns) -> float | None:
    """The first time at which the speeds of the original and the changed vehicle differ by more
    than `MIN_DIVERGENCE` [s]; None if there is no such time, or if nothing is changed.
    """
    trace = runs.trace
    have_diverged = trace.active.all(axis=1) & (
        np.ptp(trace.speed, axis=1) > MIN_DIVERGENCE
    )
    if have_diverged.any():
        return float(trace.time[np.argmax(have_diverged)])
    return None


def _heading(comparison: Comparison) -> str:
    """The study's title and, below it, the changes. Lines break only between two changes."""
    # The spaces of a change are replaced by "\0", at which no line breaks.
    changes = ", ".join(change.replace(" ", "\0") for change in comparison.changes)
    line = "the original vehicle"
    if changes:
        line = f"changed: {changes}"
    lines = [
        *textwrap.wrap(comparison.title, LINE_LENGTH),
        *textwrap.wrap(line, LINE_LENGTH),
    ]
    return "\n".join(lines).replace("\0", " ")
