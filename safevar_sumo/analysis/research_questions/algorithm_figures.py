"""Figures that compare algorithms: fronts, convergence, critical differences, and what their runs attain."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.analysis.figures import FONT, as_formula, escape_dollars, new_figure
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.comparisons import rank_algorithms
from safevar_sumo.analysis.research_questions.indicators import (
    INDICATOR_TITLES,
    REFERENCE_COORDINATE,
    SURFACE_PERCENTAGES,
    compute_attainment,
    compute_convergence,
    defined_minimised_values,
    nondominated_points,
)
from safevar_sumo.analysis.research_questions.statistics import ALPHA
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, F_SAFE, Objective
from safevar_sumo.records import FloatArray
from safevar_sumo.study import SAFETY_DEGREE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's colours, which colour-blind readers can distinguish; each also has its own marker and line style."""
MARKERS, DASHES = ("o", "X", "^", "s", "D", "v"), ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))
OBJECTIVE_TITLES = {F_SAFE.name: "f_safe: safety degree [m, -m/s]",
                    F_DIFF.name: "f_diff: largest change [fraction of the original]",
                    F_NUM_DIFF.name: "f_numDiff: characteristics changed"}
ALGORITHM_HEIGHT = 0.34
"""Height of an algorithm's line in a diagram of critical differences [inch]."""


def draw_pareto_fronts(case: Case) -> Figure:
    """The non-dominated solutions of all runs of each algorithm together, for every pair of objectives.

    Each panel also shows the original vehicle; solutions on the dashed line or to its left are collisions.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    objectives = case.scoring.objectives
    points_by_algorithm = {algorithm: defined_minimised_values(case, case.solutions_of(algorithm))
                           for algorithm in case.algorithms}
    fronts = {algorithm: nondominated_points(points) * [objective.sign for objective in objectives]
              for algorithm, points in points_by_algorithm.items() if len(points)}
    if not fronts:
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    pairs = list(combinations(range(len(objectives)), 2))
    rows = next(rows for rows in (5, 2, 1) if len(pairs) % (3 * rows) == 0 or rows == 1)
    columns = len(pairs) // rows
    figure, axes = new_figure(f"{case.name}: non-dominated solutions of each algorithm, all runs together", rows,
                              columns,
                              (max(3.2 * columns, 5), 3.7 * rows))
    known_values = {F_DIFF.name: 0.0, F_NUM_DIFF.name: 0.0, F_SAFE.name: case.original.get(SAFETY_DEGREE, np.nan)}
    original = [known_values.get(objective.name, case.original.get(objective.name, np.nan)) for objective in objectives]
    for axis, (first, second) in zip(axes.flat, pairs, strict=True):
        for i, (algorithm, points) in enumerate(fronts.items()):
            axis.plot(points[:, first], points[:, second], linestyle="", marker=MARKERS[i % len(MARKERS)], markersize=4,
                      alpha=0.6,
                      markeredgewidth=0, color=COLOURS[i % len(COLOURS)], label=f"{_title(algorithm)} ({len(points)})")
        if not np.isnan([original[first], original[second]]).any():
            axis.plot(original[first], original[second], linestyle="", marker="*", markersize=9, color="black",
                      label="original vehicle")
        if objectives[first] == F_SAFE:
            axis.axvline(0, color="black", linewidth=0.8, linestyle="--", label="collision: 0 or less")
        _label_axes(axis, (objectives[first], objectives[second]))
    _add_legend_below(figure, axes.flat[0])
    return figure


def draw_convergence(case: Case) -> Figure:
    """Convergence: the hypervolume of all settings so far over the number of evaluations, as median and range over the
    runs.
    """
    growth = compute_convergence(case)
    figure, ((axis,),) = new_figure(f"{case.name}: convergence", rows=1, columns=1, size=(6.4, 4.0))
    for i, (algorithm, group) in enumerate(growth.groupby("algorithm", sort=False)):
        statistics = group.groupby("evaluations")["hypervolume"].agg(["min", "median", "max"])
        colour, dashes = COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]
        axis.fill_between(statistics.index, statistics["min"], statistics["max"], color=colour, alpha=0.12, linewidth=0)
        axis.plot(statistics.index, statistics[["min", "max"]], color=colour, linestyle=dashes, linewidth=0.6)
        axis.plot(statistics.index, statistics["median"], color=colour, linestyle=dashes, linewidth=1.8,
                  label=f"{_title(str(algorithm))} ({group['run'].nunique()} runs)")
    axis.set(xlabel="evaluations", ylabel="normalised hypervolume of all settings so far\n"
                                          "(thick: median, thin: range over runs; "
                                          f"reference point {REFERENCE_COORDINATE:g})")
    _add_legend_below(figure, axis)
    return figure


def draw_critical_differences(case: Case) -> Figure:
    """Mean ranks of the algorithms for each quality indicator; a bar joins ranks that Nemenyi's test does not
    distinguish.

    Raises
    ------
    UnanswerableError
        If there are fewer than three algorithms, or too few runs in which all of them have solutions.
    """
    frame = rank_algorithms(case)
    frame = frame[frame["metric"].isin(list(INDICATOR_TITLES)) & frame["mean_rank"].notna()]
    if frame.empty:
        raise UnanswerableError(case.name, "has no run in which every algorithm has solutions",
                                "results of three algorithms or more")
    algorithm_count, run_count = frame["algorithm"].nunique(), frame["runs"].iloc[0]
    difference = frame["critical_difference"].iloc[0]
    if difference >= algorithm_count - 1:
        problem = f"{number_of(run_count, 'run')} are too few for a figure of critical differences"
        raise UnanswerableError(case.name, f"{problem}: its bar would join all algorithms, whatever their ranks",
                                "results of more runs")
    panel_count = frame["metric"].nunique()
    title = f"{case.name}: mean ranks over {run_count} runs, critical difference {difference:.2f}"
    figure, axes = new_figure(title, panel_count, columns=1,
                              size=(6.8, 0.9 + panel_count * (0.75 + ALGORITHM_HEIGHT * algorithm_count)))
    for axis, (metric, ranks) in zip(axes.flat, frame.groupby("metric", sort=False), strict=True):
        ranks = ranks.sort_values("mean_rank", kind="stable")
        _draw_mean_ranks(axis, ranks["algorithm"].tolist(), ranks["mean_rank"].to_numpy(dtype=float), difference)
        axis.set(ylabel=INDICATOR_TITLES[str(metric)], xlabel="mean rank, 1 is best")
    figure.supxlabel("a bar joins ranks that differ by less than the critical difference "
                     f"(Nemenyi's test at {ALPHA:g})", fontsize=FONT)
    return figure


def _draw_mean_ranks(axis: Axes, algorithms: Sequence[str], mean_ranks: FloatArray, critical_difference: float) -> None:
    count = len(algorithms)
    axis.set(xlim=(0.85, 1.25 * count), ylim=(-0.6 * count - 0.4, count), xticks=range(1, count + 1), yticks=[])
    for height, (name, rank) in zip(range(count - 1, -1, -1), zip(algorithms, mean_ranks, strict=True), strict=True):
        axis.plot([rank, rank], [height, -0.2], color="black", linewidth=0.8)
        axis.plot(rank, height, marker="o", markersize=4, color=COLOURS[0])
        axis.annotate(f"{_title(name)} {rank:.2f}", (rank, height), xytext=(6, 0), textcoords="offset points",
                      va="center", fontsize=FONT)
    for bar, (first, last) in enumerate(find_cliques(mean_ranks, critical_difference)):
        axis.plot([mean_ranks[first] - 0.03, mean_ranks[last] + 0.03], [-0.6 - 0.5 * bar] * 2, color=COLOURS[1],
                  linewidth=3,
                  solid_capstyle="round")
    axis.grid(visible=False)
    axis.spines[["left", "right"]].set_visible(False)


def find_cliques(mean_ranks: FloatArray, critical_difference: float) -> list[tuple[int, int]]:
    """First and last index of each maximal group of sorted mean ranks that differ by less than the critical
    difference.
    """
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
    figure, axes = new_figure(f"{case.name}: empirical attainment", rows, columns,
                              (max(3.0 * columns, 5.2), 0.8 + 3.1 * rows),
                              sharex=True, sharey=True)
    signs = np.array([objective.sign for objective in objectives])
    worst = np.concatenate([points * signs for by_percentage in surfaces.values()
                            for points in by_percentage.values()]).max(axis=0)
    labels = {SURFACE_PERCENTAGES[0]: "half of the runs", SURFACE_PERCENTAGES[1]: "every run"}
    for axis, (algorithm, by_percentage) in zip(axes.flat, surfaces.items(), strict=False):
        for i, (percentage, points) in enumerate(by_percentage.items()):
            # of the border of the region that the points dominate
            corners = np.array(sorted((points * signs).tolist()))
            x = np.concatenate([corners[:1, 0], corners[:, 0], worst[:1]]) * signs[0]
            y = np.concatenate([worst[1:], corners[:, 1], corners[-1:, 1]]) * signs[1]
            axis.step(x, y, where="post", color=COLOURS[i % len(COLOURS)], linestyle=DASHES[i % 3], linewidth=1.4,
                      label=labels.get(percentage, "at least one run"))
        axis.set_title(_title(algorithm), fontsize=FONT)
        _label_axes(axis, objectives)
        axis.tick_params(labelbottom=True, labelleft=True)
    for axis in list(axes.flat)[len(surfaces):]:
        axis.set_axis_off()
    _add_legend_below(figure, axes.flat[0])
    return figure


def _label_axes(axis: Axes, objectives: Sequence[Objective]) -> None:
    labels = [OBJECTIVE_TITLES.get(objective.name)
              or f"{escape_dollars(objective.title)} [{as_formula(objective.unit)}]"
              for objective in objectives]
    axis.set(xlabel=labels[0], ylabel=labels[1])


def _add_legend_below(figure: Figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 3), frameon=False, fontsize=FONT)


def _title(algorithm: str) -> str:
    return escape_dollars(ALGORITHM_TITLES.get(algorithm, algorithm))
