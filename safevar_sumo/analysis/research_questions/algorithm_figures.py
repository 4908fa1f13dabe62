"""Figures that compare algorithms: fronts, convergence, critical differences, and what their runs attain."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, cycle
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.analysis.figures import FONT, as_formula, escape_dollars, new_figure, new_panels
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
from safevar_sumo.study import SAFETY_DEGREE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's colours, which colour-blind readers can distinguish; each also has its own marker."""
MARKERS = ("o", "X", "^", "s", "D", "v")
OBJECTIVE_TITLES = {
    F_SAFE.name: "f_safe: safety degree [m, -m/s]",
    F_DIFF.name: "f_diff: largest change [fraction of the original]",
    F_NUM_DIFF.name: "f_numDiff: characteristics changed",
}
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
    fronts = {
        algorithm: nondominated_points(points) * [objective.sign for objective in objectives]
        for algorithm in case.algorithms
        if len(points := defined_minimised_values(case, case.solutions_of(algorithm)))
    }
    if not fronts:
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    pairs = list(combinations(range(len(objectives)), 2))
    rows = next(rows for rows in (5, 2, 1) if len(pairs) % (3 * rows) == 0 or rows == 1)
    columns = len(pairs) // rows
    title = f"{case.name}: non-dominated solutions of each algorithm, all runs together"
    figure, axes = new_figure(title, rows, columns, (max(3.2 * columns, 5), 3.7 * rows))
    known_values = {F_DIFF.name: 0.0, F_NUM_DIFF.name: 0.0, F_SAFE.name: case.original.get(SAFETY_DEGREE, np.nan)}
    original = [{**case.original, **known_values}.get(objective.name, np.nan) for objective in objectives]
    for axis, pair in zip(axes.flat, pairs, strict=True):
        for (algorithm, points), colour, marker in zip(fronts.items(), cycle(COLOURS), cycle(MARKERS), strict=False):
            axis.scatter(
                *points[:, pair].T,
                marker=marker,
                s=16,
                alpha=0.6,
                linewidths=0,
                color=colour,
                label=f"{_title(algorithm)} ({len(points)})",
            )
        axis.scatter(*(original[i] for i in pair), marker="*", s=80, color="black", label="original vehicle")
        if objectives[pair[0]] == F_SAFE:
            axis.axvline(0, color="black", linewidth=0.8, linestyle="--", label="collision: 0 or less")
        _label_axes(axis, [objectives[i] for i in pair])
    _add_legend_below(figure, axes.flat[0])
    return figure


def draw_convergence(case: Case) -> Figure:
    """The hypervolume of all settings so far over the number of evaluations, as median and range over the runs."""
    import seaborn as sns

    growth = compute_convergence(case)
    runs = growth.groupby("algorithm")["run"].nunique()
    labels = {algorithm: f"{_title(algorithm)} ({runs[algorithm]} runs)" for algorithm in growth["algorithm"].unique()}
    figure, ((axis,),) = new_figure(f"{case.name}: convergence", rows=1, columns=1, size=(6.4, 4.0))
    sns.lineplot(
        growth.assign(algorithm=growth["algorithm"].map(labels)),
        x="evaluations",
        y="hypervolume",
        hue="algorithm",
        style="algorithm",
        estimator="median",
        errorbar=("pi", 100),
        palette=COLOURS[: len(labels)],
        ax=axis,
    )
    axis.set_ylabel(
        "normalised hypervolume of all settings so far\n(line: median, band: range over runs; "
        f"reference point {REFERENCE_COORDINATE:g})"
    )
    _add_legend_below(figure, axis)
    axis.get_legend().remove()
    return figure


def draw_critical_differences(case: Case) -> Figure:
    """Mean ranks of the algorithms for each quality indicator; Nemenyi's test does not distinguish ranks whose bars
    overlap.

    Raises
    ------
    UnanswerableError
        If there are fewer than three algorithms, or too few runs in which all of them have solutions.
    """
    frame = rank_algorithms(case)
    frame = frame[frame["metric"].isin(list(INDICATOR_TITLES)) & frame["mean_rank"].notna()]
    if frame.empty:
        raise UnanswerableError(
            case.name, "has no run in which every algorithm has solutions", "results of three algorithms or more"
        )
    algorithm_count, run_count = frame["algorithm"].nunique(), frame["runs"].iloc[0]
    difference = frame["critical_difference"].iloc[0]
    if difference >= algorithm_count - 1:
        problem = f"{number_of(run_count, 'run')} are too few for a figure of critical differences"
        raise UnanswerableError(
            case.name, f"{problem}: all bars would overlap, whatever the ranks", "results of more runs"
        )
    metrics = frame["metric"].unique()
    title = f"{case.name}: mean ranks over {run_count} runs, critical difference {difference:.2f}"
    figure, axes = new_figure(
        title, len(metrics), 1, (6.8, 0.9 + len(metrics) * (0.6 + ALGORITHM_HEIGHT * algorithm_count))
    )
    for axis, metric in zip(axes.flat, metrics, strict=True):
        ranks = frame[frame["metric"] == metric].sort_values("mean_rank", ascending=False, kind="stable")
        names = [f"{_title(row['algorithm'])} {row['mean_rank']:.2f}" for row in ranks.to_dict("records")]
        axis.errorbar(
            ranks["mean_rank"], names, xerr=difference / 2, linestyle="", marker="o", color=COLOURS[0], capsize=3
        )
        axis.set(ylabel=INDICATOR_TITLES[metric], xlabel="mean rank, 1 is best")
        axis.margins(y=0.25)
    figure.supxlabel(
        "bars of one critical difference: ranks whose bars overlap are not distinguished "
        f"(Nemenyi's test at {ALPHA:g})",
        fontsize=FONT,
    )
    return figure


def draw_attainment_surfaces(case: Case) -> Figure:
    """What at least one run, half of the runs and every run of each algorithm attain in the first two objectives.

    Raises
    ------
    UnanswerableError
        If there are no runs with solutions.
    """
    surfaces, objectives = compute_attainment(case), case.scoring.objectives[:2]
    figure, axes = new_panels(f"{case.name}: empirical attainment", len(surfaces), 3, (3.0, 3.1), 5.2, 0.8)
    for axis in axes[1:]:
        axis.sharex(axes[0])
        axis.sharey(axes[0])
    signs = np.array([objective.sign for objective in objectives])
    minimised = {
        algorithm: {percentage: np.array(sorted((points * signs).tolist())) for percentage, points in surface.items()}
        for algorithm, surface in surfaces.items()
    }
    worst = np.max([points.max(axis=0) for surface in minimised.values() for points in surface.values()], axis=0)
    labels = {SURFACE_PERCENTAGES[0]: "half of the runs", SURFACE_PERCENTAGES[1]: "every run"}
    for axis, (algorithm, surface) in zip(axes, minimised.items(), strict=True):
        for (percentage, points), colour, dashes in zip(surface.items(), COLOURS, ("-", "--", "-."), strict=False):
            border = np.concatenate([[[points[0, 0], worst[1]]], points, [[worst[0], points[-1, 1]]]]) * signs
            axis.step(
                *border.T,
                where="post",
                color=colour,
                linestyle=dashes,
                label=labels.get(percentage, "at least one run"),
            )
        axis.set_title(_title(algorithm), fontsize=FONT)
        _label_axes(axis, objectives)
    _add_legend_below(figure, axes[0])
    return figure


def _label_axes(axis: Axes, objectives: Sequence[Objective]) -> None:
    labels = [
        OBJECTIVE_TITLES.get(objective.name) or f"{escape_dollars(objective.title)} [{as_formula(objective.unit)}]"
        for objective in objectives
    ]
    axis.set(xlabel=labels[0], ylabel=labels[1])


def _add_legend_below(figure: Figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 3), frameon=False, fontsize=FONT)


def _title(algorithm: str) -> str:
    return escape_dollars(ALGORITHM_TITLES.get(algorithm, algorithm))
