"""Figures that compare algorithms: critical differences, and the part of the objective space that their runs attain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.analysis.figures import FONT, escape_dollars, new_figure
from safevar_sumo.analysis.research_questions.algorithms import SURFACE_PERCENTAGES, compute_attainment, rank_algorithms
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.comparisons import ALPHA
from safevar_sumo.analysis.research_questions.figures import COLOURS, add_legend_below, objective_title
from safevar_sumo.analysis.research_questions.indicators import INDICATOR_TITLES
from safevar_sumo.records import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALGORITHM_HEIGHT = 0.34
"""Height of an algorithm's line in a diagram [inch]."""


def draw_critical_differences(case: Case) -> Figure:
    """Mean ranks of the algorithms for each quality indicator; a bar joins ranks that Nemenyi's test does not distinguish.

    Raises
    ------
    UnanswerableError
        If there are fewer than three algorithms, or no run in which all of them have solutions.
    """
    frame = rank_algorithms(case)
    frame = frame[frame["metric"].isin(list(INDICATOR_TITLES)) & frame["mean_rank"].notna()]
    if frame.empty:
        raise UnanswerableError(case.name, "has no run in which every algorithm has solutions", "results of three algorithms or more")
    metrics, algorithm_count = list(dict.fromkeys(frame["metric"])), frame["algorithm"].nunique()
    run_count, critical_difference = int(frame["runs"].iloc[0]), float(frame["critical_difference"].iloc[0])
    if critical_difference >= algorithm_count - 1:
        raise UnanswerableError(case.name, f"has {run_count} runs in which all {algorithm_count} algorithms have solutions: too few for "
                                "critical differences, which no mean ranks exceed", "results of more runs")
    title = f"{case.name}: mean ranks over {run_count} runs, critical difference {critical_difference:.2f}"
    figure, axes = new_figure(title, len(metrics), columns=1,
                              size=(6.8, 0.9 + len(metrics) * (0.75 + ALGORITHM_HEIGHT * algorithm_count)))
    for axis, metric in zip(axes.flat, metrics, strict=True):
        metric_ranks = frame[frame["metric"] == metric].sort_values("mean_rank", kind="stable")
        _draw_mean_ranks(axis, metric_ranks["algorithm"].tolist(), metric_ranks["mean_rank"].to_numpy(dtype=float), critical_difference)
        axis.set_ylabel(INDICATOR_TITLES[metric])
        axis.set_xlabel("mean rank, 1 is best")
    figure.supxlabel(f"a bar joins ranks that differ by less than the critical difference (Nemenyi's test at {ALPHA:g})", fontsize=FONT)
    return figure


def _draw_mean_ranks(axis: Axes, algorithms: list[str], mean_ranks: FloatArray, critical_difference: float) -> None:
    algorithm_count = len(algorithms)
    axis.set_xlim(0.85, algorithm_count + 0.25 * algorithm_count)
    axis.set_ylim(-0.6 * len(mean_ranks) - 0.4, algorithm_count)
    for index, (name, rank) in enumerate(zip(algorithms, mean_ranks, strict=True)):
        height = algorithm_count - 1 - index
        axis.plot([rank, rank], [height, -0.2], color="black", linewidth=0.8)
        axis.plot(rank, height, marker="o", markersize=4, color="#0072b2")
        axis.annotate(f"{escape_dollars(ALGORITHM_TITLES.get(name, name))} {rank:.2f}", (rank, height), xytext=(6, 0),
                      textcoords="offset points", va="center", fontsize=FONT)
    for bar, (first, last) in enumerate(find_cliques(mean_ranks, critical_difference)):
        axis.plot([mean_ranks[first] - 0.03, mean_ranks[last] + 0.03], [-0.6 - 0.5 * bar] * 2, color="#d55e00", linewidth=3,
                  solid_capstyle="round")
    axis.set_yticks([])
    axis.grid(visible=False)
    for spine in ("left", "right"):
        axis.spines[spine].set_visible(False)
    axis.set_xticks(range(1, algorithm_count + 1))
    axis.xaxis.set_ticks_position("bottom")


def find_cliques(mean_ranks: FloatArray, critical_difference: float) -> list[tuple[int, int]]:
    """First and last index of each maximal group of sorted mean ranks that differ by less than the critical difference."""
    groups: list[tuple[int, int]] = []
    for first in range(len(mean_ranks)):
        last = int(np.flatnonzero(mean_ranks - mean_ranks[first] < critical_difference)[-1])
        if last > first and (not groups or last > groups[-1][1]):
            groups.append((first, last))
    return groups


def draw_attainment_surfaces(case: Case) -> Figure:
    """What at least one run, half of the runs and every run of each algorithm attain in the first two objectives.

    Raises
    ------
    UnanswerableError
        If there are no runs with solutions.
    """
    surfaces, objectives = compute_attainment(case), case.scoring.objectives[:2]
    columns = min(len(surfaces), 3)
    rows = -(-len(surfaces) // columns)
    figure, axes = new_figure(f"{case.name}: empirical attainment", rows, columns, (max(3.0 * columns, 5.2), 0.8 + 3.1 * rows))
    all_points = np.concatenate([points for surfaces_by_percentage in surfaces.values() for points in surfaces_by_percentage.values()])
    for axis, (algorithm, surfaces_by_percentage) in zip(axes.flat, surfaces.items(), strict=False):
        worst_values = np.array([np.min(all_points[:, i]) if objective.maximised else np.max(all_points[:, i])
                                 for i, objective in enumerate(objectives)])
        for i, (percentage, points) in enumerate(surfaces_by_percentage.items()):
            label = {SURFACE_PERCENTAGES[0]: "half of the runs", SURFACE_PERCENTAGES[1]: "every run"}.get(percentage, "at least one run")
            axis.plot(*_staircase_corners(points, worst_values).T, color=COLOURS[i % len(COLOURS)], linestyle=("-", "--", "-.")[i % 3],
                      linewidth=1.4, label=label)
        axis.set_title(escape_dollars(ALGORITHM_TITLES.get(algorithm, algorithm)), fontsize=FONT)
        axis.set_xlabel(objective_title(objectives[0]))
        axis.set_ylabel(objective_title(objectives[1]))
    for axis in list(axes.flat)[len(surfaces):]:
        axis.set_axis_off()
    add_legend_below(figure, axes.flat[0])
    return figure


def _staircase_corners(points: FloatArray, worst_values: FloatArray) -> FloatArray:
    """K corners of the border of the region that the points dominate, from the second objective's worst value to the first's; (K, 2)."""
    staircase = points[np.argsort(points[:, 0], kind="stable")]
    if worst_values[0] < np.mean(staircase[:, 0]):  # the first objective is maximised
        staircase = staircase[::-1]
    border = [(staircase[0, 0], worst_values[1])]
    for index, (x, y) in enumerate(staircase):
        border.append((x, y))
        border.append((staircase[index + 1, 0] if index + 1 < len(staircase) else worst_values[0], y))
    return np.array(border)
