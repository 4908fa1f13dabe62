"""Draws all figures of results: how algorithms compare (RQ1, RQ2), and what critical solutions
(less safe than the original vehicle) change (RQ3).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations, cycle, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.errors import warn
from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, F_SAFE
from safevar_sumo.questions.case import Results, UnanswerableError
from safevar_sumo.questions.figures import (
    BLUE,
    FONT_SIZE,
    SKY_BLUE,
    VERMILION,
    as_formula,
    escape_dollars,
    new_figure,
    new_panels,
    own_style,
    save,
)
from safevar_sumo.questions.research_questions.changes import (
    ANY,
    changes_of,
    rq31,
    rq32,
)
from safevar_sumo.questions.research_questions.fronts import (
    compute_convergence,
    compute_indicators,
    count_evaluations,
    nondominated_points,
    points_of,
    reference_front,
)
from safevar_sumo.records import FloatArray
from safevar_sumo.results import make_directory
from safevar_sumo.study import SAFETY_DEGREE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALGORITHM_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours by Okabe and Ito, which colour-blind readers can distinguish. Each algorithm also has a
marker of its own (`MARKERS`).
"""
MARKERS = ("o", "X", "^", "s", "D", "v")
OBJECTIVE_TITLES = {
    F_SAFE.name: "f_safe: safety degree [m, -m/s]",
    F_DIFF.name: "f_diff: largest change [fraction of the original]",
    F_NUM_DIFF.name: "f_numDiff: characteristics changed",
}
LONGEST_NAME = 28
"""Number of letters that fit above a small panel. A longer name has a smaller font."""
BIN_COUNT = 24
"""Number of bins of a histogram over a characteristic's domain."""


def draw_pareto_fronts(case: Results) -> Figure:
    """The non-dominated solutions of all runs of each algorithm together, for every pair of
    objectives.

    Each panel also shows the original vehicle; solutions on the dashed line or to its left are
    collisions.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    # The call raises an error if there is no solution.
    reference_front(case)

    objectives = case.scoring.objectives
    signs = [objective.sign for objective in objectives]
    fronts = {}
    for algorithm in case.algorithms:
        points = points_of(case, case.solutions_of(algorithm))
        if len(points):
            fronts[algorithm] = nondominated_points(points) * signs

    pairs = list(combinations(range(len(objectives)), 2))
    title = f"{case.name}: non-dominated solutions of each algorithm, all runs together"
    figure, axes = new_panels(
        title, len(pairs), 3, (3.2, 3.7), min_width=5.0, title_height=0.0
    )

    # The original vehicle is drawn in the same axes, with no change of itself.
    original = {
        **case.original_metrics,
        F_DIFF.name: 0.0,
        F_NUM_DIFF.name: 0.0,
        F_SAFE.name: case.original_metrics.get(SAFETY_DEGREE, np.nan),
    }
    labels = []
    values = []
    for objective in objectives:
        label = f"{escape_dollars(objective.title)} [{as_formula(objective.unit)}]"
        labels.append(OBJECTIVE_TITLES.get(objective.name, label))
        values.append(original.get(objective.name, np.nan))
    for axis, pair in zip(axes, pairs, strict=True):
        for (algorithm, points), colour, marker in zip(
            fronts.items(), cycle(ALGORITHM_COLOURS), cycle(MARKERS), strict=False
        ):
            label = f"{escape_dollars(case.title_of(algorithm))} ({len(points)})"
            x, y = points[:, pair].T
            axis.scatter(
                x,
                y,
                marker=marker,
                s=16,
                alpha=0.6,
                linewidths=0,
                color=colour,
                label=label,
            )
        across, up = pair
        axis.scatter(
            values[across],
            values[up],
            marker="*",
            s=80,
            color="black",
            label="original vehicle",
        )
        if objectives[across] == F_SAFE:
            axis.axvline(
                0,
                color="black",
                linewidth=0.8,
                linestyle="--",
                label="collision: 0 or less",
            )
        axis.set(xlabel=labels[across], ylabel=labels[up])
    _add_legend_below(figure, axes[0])
    return figure


def draw_convergence(case: Results) -> Figure:
    """The convergence of each algorithm: the hypervolume of all settings that a run has simulated
    so far, over their number, as median and quartiles over the runs.

    A line ends with the longest run of its algorithm. The mark there is the median hypervolume of
    the solutions that the runs return. The legend says how many settings a run simulates on
    average: fewer than the budget if the run repeats settings or ends early.
    """
    import seaborn as sns

    growth = compute_convergence(case)
    runs = growth.groupby("algorithm", sort=False)["run"].nunique()
    means = count_evaluations(case).groupby("algorithm")["simulated"].mean().to_dict()
    labels = {}
    for algorithm, count in runs.items():
        title = escape_dollars(case.title_of(str(algorithm)))
        mean = f"mean: {means[algorithm]:,.0f} simulations"
        labels[algorithm] = f"{title} ({count} runs)\n{mean}"
    figure, ((axis,),) = new_figure(
        f"{case.name}: convergence", rows=1, columns=1, size=(6.4, 4.0)
    )
    sns.lineplot(
        growth.assign(algorithm=growth["algorithm"].map(labels)),
        x="evaluations",
        y="hypervolume",
        hue="algorithm",
        style="algorithm",
        estimator="median",
        errorbar=("pi", 50),
        palette=ALGORITHM_COLOURS[: len(labels)],
        ax=axis,
    )
    axis.set_xlabel("simulations of different settings")
    axis.set_ylabel(
        "normalised hypervolume of all settings so far\n(line: median, band: quartiles over runs;\n"
        f"mark: of what a run returns; reference point {case.study.search.reference_point:g})"
    )

    ends = growth.groupby("algorithm", sort=False)["evaluations"].max()
    returned = (
        compute_indicators(case)["hypervolume"]
        .groupby(level="algorithm")
        .median()
        .reindex(ends.index)
    )
    axis.scatter(
        ends,
        returned,
        color=ALGORITHM_COLOURS[: len(ends)],
        edgecolor="black",
        zorder=3,
    )
    _add_legend_below(figure, axis)
    axis.get_legend().remove()
    return figure


def _add_legend_below(figure: Figure, axis: Axes) -> None:
    """Add the legend of a panel below the figure."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=min(len(labels), 3),
        frameon=False,
        fontsize=FONT_SIZE,
    )


def draw_change_counts(cases: Sequence[Results]) -> Figure:
    """RQ3.1: the number of a run's critical solutions that change j characteristics, as box plots
    over the runs. Each case with an answer has a panel.

    Raises
    ------
    UnanswerableError
        If no case has an answer.
    """
    counts_by_case = {}
    errors = []
    for case in cases:
        try:
            counts_by_case[case.name] = rq31(case)
        except UnanswerableError as error:
            errors.append(error)
    if not counts_by_case:
        raise errors[0]

    title = "number of changed characteristics"
    figure, axes = new_panels(
        title, len(counts_by_case), 3, (3.9, 3.3), min_width=6.4, title_height=0.5
    )
    for axis, (name, counts) in zip(axes, counts_by_case.items(), strict=True):
        numbers, samples = zip(*counts.groupby("j", sort=False)["count"], strict=True)
        axis.boxplot(
            samples,
            tick_labels=numbers,
            widths=0.8,
            patch_artist=True,
            boxprops={"facecolor": SKY_BLUE},
        )
        runs = counts["run"].nunique()
        axis.set(
            xlabel="characteristics changed",
            ylabel=f"critical solutions per run\n({runs} runs)",
        )
        axis.set_title(escape_dollars(name), fontsize=FONT_SIZE)
        axis.locator_params(axis="y", integer=True, min_n_ticks=1)
    return figure


def draw_changed_characteristics(case: Results) -> Figure:
    """RQ3.2 as a heat map: the share of critical solutions with j changed characteristics in which
    each characteristic is changed.
    """
    import seaborn as sns

    # The call raises an error if there are no critical solutions.
    _critical_changes(case)

    # The most frequently changed characteristic is the first row.
    shares = rq32(case)
    ranks = shares[shares["j"] == ANY].sort_values("rank", kind="stable")
    table = shares.pivot(index="characteristic", columns="j", values="percent")
    table = table.loc[ranks["characteristic"], shares["j"].unique()]
    title = f"{case.name}: characteristics changed in critical solutions"
    figure, ((axis,),) = new_figure(
        title, rows=1, columns=1, size=(7.6, 1.4 + 0.3 * len(table))
    )
    sns.heatmap(
        table.rename(index=escape_dollars),
        ax=axis,
        cmap="cividis",
        vmin=0,
        vmax=100,
        annot=True,
        fmt=".0f",
        annot_kws={"fontsize": 7},
        linewidths=0.5,
        cbar_kws={"label": "critical solutions\nin which it is changed [%]"},
    )
    axis.set(
        xlabel="number of characteristics changed (empty: no such solution)",
        ylabel="characteristic, most frequent first",
    )
    axis.tick_params(axis="both", length=0, rotation=0)
    return figure


def draw_change_sizes(case: Results) -> Figure:
    """The distribution of each characteristic's signed changes in the critical solutions."""
    changes_of_solutions = _critical_changes(case)
    title = f"{case.name}: changes in critical solutions"

    vehicle = case.characteristics.vehicle
    figure, axes = new_panels(
        title, len(vehicle), 4, (2.25, 1.85), min_width=9.0, title_height=1.0
    )
    for axis, characteristic, changes in zip(
        axes, vehicle, changes_of_solutions.T, strict=True
    ):
        low = characteristic.lower - characteristic.original
        high = characteristic.upper - characteristic.original

        increases = changes[changes > 0]
        decreases = changes[changes < 0]
        axis.hist(
            [increases, decreases],
            bins=BIN_COUNT,
            range=(low, high),
            color=[VERMILION, BLUE],
            stacked=True,
        )
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set_xlim(low, high)
        axis.set_title(
            f"{escape_dollars(characteristic.name)}\n+{len(increases)}, -{len(decreases)}",
            fontsize=min(
                FONT_SIZE, FONT_SIZE * LONGEST_NAME / len(characteristic.name)
            ),
        )
        axis.set_xlabel(
            f"change [{as_formula(characteristic.unit)}]", fontsize=FONT_SIZE
        )
        axis.locator_params(axis="x", nbins=3, steps=[1, 2, 5, 10])
        axis.locator_params(axis="y", nbins=4, integer=True, min_n_ticks=1)
    figure.supylabel(
        f"number of critical solutions (of {len(changes_of_solutions)})", fontsize=9
    )
    figure.supxlabel(
        "orange, right of 0: increases; blue, left of 0: decreases; titles count them;\n"
        "each axis spans the characteristic's domain",
        fontsize=FONT_SIZE,
    )
    return figure


def _critical_changes(case: Results) -> FloatArray:
    """The changes of the M critical solutions, shape (M, n). Raises UnanswerableError if there are
    no critical solutions.
    """
    changes = changes_of(case)
    if not len(changes):
        raise UnanswerableError(
            case.name,
            "has no critical solution",
            "results with solutions that are more unsafe than the original",
        )
    return changes


COUNTS_FIGURE = "rq3.1-number-of-changes"
"""Name of the figure that shows all cases side by side."""
FIGURES_OF_ONE_CASE: Mapping[str, Callable[[Results], Figure]] = {
    "rq3.2-changed-characteristics": draw_changed_characteristics,
    "rq3.3-sizes-of-changes": draw_change_sizes,
    "pareto-fronts": draw_pareto_fronts,
    "convergence": draw_convergence,
}


@own_style()
def draw_figures(cases: Sequence[Results]) -> dict[str, Figure]:
    """Every figure of the cases by name; with several cases, names start with the case's name.

    Warns
    -----
    UserWarning
        For each reason why figures are missing.

    Raises
    ------
    UnanswerableError
        If no figure can be drawn.
    """
    figures = {}
    errors = []
    drawings = {COUNTS_FIGURE: partial(draw_change_counts, cases)}
    for case, (name, draw) in product(cases, FIGURES_OF_ONE_CASE.items()):
        key = f"{case.name}-{name}" if len(cases) > 1 else name
        drawings[key] = partial(draw, case)
    for name, draw_figure in drawings.items():
        try:
            figures[name] = draw_figure()
        except UnanswerableError as error:
            errors.append(error)

    if not figures:
        raise errors[0]
    reasons = [f"no figure: {error.source}: {error.problem}" for error in errors]
    for reason in dict.fromkeys(reasons):
        warn(reason)
    return figures


def save_figures(cases: Sequence[Results], directory: Path) -> None:
    """Draw every figure into a png and a pdf file.

    Raises
    ------
    InputError
        If the directory cannot be written, or no figure can be drawn.
    """
    figures = draw_figures(cases)
    make_directory(directory)
    for name, figure in figures.items():
        full_name = f"{cases[0].name}-{name}" if len(cases) == 1 else name
        file_name = re.sub(r"[^\w.-]", "-", full_name).strip("-")
        for ending in ("png", "pdf"):
            save(figure, directory / f"{file_name}.{ending}", "figures")
