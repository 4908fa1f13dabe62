"""The original and a changed vehicle in one figure: speed, gap, pedals and time to collision over time."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

from safevar_sumo.metrics import time_to_collision
from safevar_sumo.records import STANDSTILL, FloatArray, SimulationRuns
from safevar_sumo.replay.comparison import CHANGED, ORIGINAL, Comparison, find_divergence, find_moments

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {ORIGINAL: "#0072b2", CHANGED: "#d55e00"}
"""Okabe and Ito's blue and vermillion."""
DASHES: Mapping[int, Literal["-", "--"]] = {ORIGINAL: "-", CHANGED: "--"}
BRAKING_MARK, NEAREST_MARK, IMPACT_MARK = "v", "o", "X"
MAX_TTC = 6.0
"""Largest time to collision that is drawn [s]."""
FONT_SIZE = 9
LINE_LENGTH = 118
"""Length of a line of the heading [characters]."""


def draw_comparison(comparison: Comparison) -> Figure:
    """Draw a comparison as a figure outside any window."""
    import matplotlib.style
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    with matplotlib.style.context(["seaborn-v0_8-whitegrid", {"font.size": FONT_SIZE, "axes.labelsize": FONT_SIZE}]):
        figure = Figure(figsize=(9.6, 6.2), layout=ConstrainedLayoutEngine(h_pad=0.06, w_pad=0.08))
        axes = figure.subplots(2, 2, sharex=True).ravel()
    speed_axis, gap_axis, pedal_axis, ttc_axis = axes
    ttc = time_to_collision(comparison.film.runs)
    for row in comparison.rows:
        _draw_speed(speed_axis, comparison, row)
        _draw_gap(gap_axis, comparison, row)
        _draw_pedals(pedal_axis, comparison, row)
        _draw_line(ttc_axis, comparison, row, np.where(ttc[:, row] <= MAX_TTC, ttc[:, row], np.nan))
    speed_axis.set_ylabel("speed [m/s]")
    gap_axis.set_ylabel("gap to the obstacle [m]")
    pedal_axis.set_ylabel("brake     |     throttle")
    ttc_axis.set_ylabel("time to collision [s]")
    gap_axis.axhline(0, color="black", linewidth=0.8)
    speed_axis.margins(y=0.1)
    gap_axis.set_ylim(-0.22 * gap_axis.get_ylim()[1], None)
    pedal_axis.set_ylim(-1.08, 1.08)
    pedal_axis.set_yticks([-1, -0.5, 0, 0.5, 1], ["1", "0.5", "0", "0.5", "1"])
    ttc_axis.set_ylim(0, None)
    ttc_axis.set_xlim(right=_end_time(comparison) * 1.25)
    ttc_axis.axhline(comparison.ttc_threshold, color="0.4", linewidth=0.9, linestyle=":")
    for axis in (pedal_axis, ttc_axis):
        axis.set_xlabel("time [s]")
    if (divergence_time := _divergence_time(comparison)) is not None:
        for axis in axes:
            axis.axvline(divergence_time, color="0.35", linewidth=0.9, linestyle="-.", zorder=1)
    _draw_heading(figure, comparison)
    _draw_legend(figure, comparison)
    return figure


def _end_time(comparison: Comparison) -> float:
    """The later of the times at which the vehicles are nearest and at rest [s]."""
    runs = comparison.film.runs
    samples = [sample for row in comparison.rows for sample in (find_moments(runs, row).nearest, _last_moving_sample(runs, row))]
    last_sample = max(sample for sample in samples if sample is not None)
    return float(runs.trace.time[min(last_sample + 1, len(runs.trace.time) - 1)])


def _last_moving_sample(runs: SimulationRuns, row: int) -> int:
    """The last sample of a run in which the vehicle moves; 0 if it never moves."""
    return int(np.flatnonzero(runs.trace.active[:, row] & (runs.trace.speed[:, row] > STANDSTILL)).max(initial=0))


def _draw_legend(figure: Figure, comparison: Comparison) -> None:
    """Draw the legend: vehicles and marks."""
    from matplotlib.lines import Line2D

    has_impact = bool(np.isfinite(comparison.film.runs.collision_speed).any())
    marks = {"begins to brake": BRAKING_MARK, "nearest": NEAREST_MARK, **({"impact": IMPACT_MARK} if has_impact else {})}
    entries = [Line2D([], [], color=COLOURS[row], linestyle=DASHES[row], label=f"{comparison.name(row)} vehicle: {comparison.verdict(row)}")
               for row in comparison.rows]
    entries += [Line2D([], [], color="0.35", marker=mark, linestyle="", markersize=7, label=label) for label, mark in marks.items()]
    if _divergence_time(comparison) is not None:
        entries.append(Line2D([], [], color="0.35", linestyle="-.", linewidth=0.9, label="speeds diverge (by 0.1 m/s)"))
    entries.append(Line2D([], [], color="0.4", linestyle=":", linewidth=0.9,
                          label=f"TTC* = {comparison.ttc_threshold:g} s: critical below"))
    figure.legend(entries, [str(entry.get_label()) for entry in entries], loc="outside lower center", ncols=3, frameon=False)


def _draw_line(axis: Axes, comparison: Comparison, row: int, values: FloatArray) -> None:
    """Draw a quantity of one run until its end."""
    end = find_moments(comparison.film.runs, row).end + 1
    time = comparison.film.runs.trace.time[:end]
    axis.plot(time, values[:end], color=COLOURS[row], linestyle=DASHES[row], linewidth=1.6, zorder=3 + row)


def _draw_mark(axis: Axes, row: int, point: tuple[float, float], mark: str, text: str = "", *, is_speed: bool = False,
               is_above: bool = False) -> None:
    """Draw a mark on a line. The original's mark is larger, to show behind the changed vehicle's mark."""
    axis.plot(*point, marker=mark, color=COLOURS[row], markersize=12 - 4 * row + 2 * (mark == IMPACT_MARK), linestyle="", zorder=6 + row,
              markeredgecolor="white")
    offset, alignment = ((3, 7), "left") if is_speed else ((0, 9 if is_above else -17), "center")
    axis.annotate(text, point, xytext=offset, textcoords="offset points", color=COLOURS[row], fontweight="bold", ha=alignment,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8}, zorder=5)


def _draw_speed(axis: Axes, comparison: Comparison, row: int) -> None:
    trace, key_moments = comparison.film.runs.trace, find_moments(comparison.film.runs, row)
    _draw_line(axis, comparison, row, trace.speed[:, row])
    if key_moments.braking_start is not None:
        _draw_mark(axis, row, (trace.time[key_moments.braking_start], trace.speed[key_moments.braking_start, row]), BRAKING_MARK)
    impact_speed = float(comparison.film.runs.collision_speed[row])
    if not np.isnan(impact_speed):
        _draw_mark(axis, row, (trace.time[key_moments.end], impact_speed), IMPACT_MARK, f"{impact_speed:.1f} m/s", is_speed=True)


def _draw_gap(axis: Axes, comparison: Comparison, row: int) -> None:
    runs = comparison.film.runs
    gap, key_moments = np.where(np.isfinite(runs.trace.gap[:, row]), runs.trace.gap[:, row], np.nan), find_moments(runs, row)
    _draw_line(axis, comparison, row, gap)
    if key_moments.nearest is not None and not np.isnan(gap[key_moments.nearest]):
        gap_text = f"{gap[key_moments.nearest]:.2f} m"
        mark, text = (NEAREST_MARK, gap_text) if np.isnan(runs.collision_speed[row]) else (IMPACT_MARK, "impact")
        nearest_gaps = np.where(runs.trace.active, runs.trace.gap, np.inf).min(axis=0)
        is_above = bool(np.argmax(nearest_gaps) == row)  # of the two texts, that of the larger gap
        _draw_mark(axis, row, (runs.trace.time[key_moments.nearest], gap[key_moments.nearest]), mark, text, is_above=is_above)


def _draw_pedals(axis: Axes, comparison: Comparison, row: int) -> None:
    trace = comparison.film.runs.trace
    _draw_line(axis, comparison, row, trace.throttle[:, row] - trace.brake[:, row])


def _divergence_time(comparison: Comparison) -> float | None:
    """The time at which the speeds of two vehicles diverge [s]; None for a single vehicle or speeds that stay together."""
    sample = find_divergence(comparison.film.runs) if len(comparison.rows) > 1 else None
    return None if sample is None else float(comparison.film.runs.trace.time[sample])


def _draw_heading(figure: Figure, comparison: Comparison) -> None:
    """Draw the study's title and, below it, the changes; lines break only between changes."""
    lines = textwrap.wrap(comparison.title, LINE_LENGTH)
    line = "changed:" if comparison.changes else "the original vehicle"
    for index, change in enumerate(comparison.changes):
        text = f" {change}{',' if index < len(comparison.changes) - 1 else ''}"
        if len(line) + len(text) > LINE_LENGTH:
            lines.append(line)
            line = text.strip()
        else:
            line += text
    figure.suptitle("\n".join([*lines, line]).replace("$", r"\$"), fontsize=FONT_SIZE + 1)
