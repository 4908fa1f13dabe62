"""Figures of results: each function takes one case, or all cases, and returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.analysis.figures import FONT, SKY_BLUE, as_formula, escape_dollars, new_figure, new_panels
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.changes import ANY, critical_solutions, list_changes, rq31, rq32
from safevar_sumo.analysis.research_questions.indicators import (
    REFERENCE_COORDINATE,
    compute_convergence,
    defined_minimised_values,
    nondominated_points,
)
from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, F_SAFE, Objective
from safevar_sumo.study import SAFETY_DEGREE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's colours, which colour-blind readers can distinguish; each also has its own marker and line style."""
MARKERS, DASHES = ("o", "X", "^", "s", "D", "v"), ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))
INCREASE_COLOUR, DECREASE_COLOUR = COLOURS[1], COLOURS[0]
OBJECTIVE_TITLES = {F_SAFE.name: "f_safe: safety degree [m, -m/s]", F_DIFF.name: "f_diff: largest change [fraction of the original]",
                    F_NUM_DIFF.name: "f_numDiff: characteristics changed"}
LONGEST_NAME = 28
"""Number of letters of a name that fit above a small axis."""
PANELS_PER_ROW = 3
"""Number of panels in a row."""
BIN_COUNT = 24
"""Number of bins over a characteristic's domain."""


def draw_change_counts(cases: Sequence[Case]) -> Figure:
    """RQ3.1: number of critical solutions of a run with j characteristics changed, as box plots over the runs; a panel per case.

    Raises
    ------
    UnanswerableError
        If `rq31` raises it for a case.
    """
    counts = [rq31(case) for case in cases]
    title = f"{cases[0].name}: number of changed characteristics" if len(cases) == 1 else "number of changed characteristics"
    figure, axes = new_panels(title, len(cases), PANELS_PER_ROW, (3.9, 3.3), min_width=6.4, title_height=0.5)
    for axis, case, group in zip(axes, cases, counts, strict=True):
        counts_by_number = {str(j): rows["count"].to_numpy() for j, rows in group.groupby("j", sort=False)}
        axis.boxplot(list(counts_by_number.values()), tick_labels=list(counts_by_number), widths=0.8, patch_artist=True,
                     boxprops={"facecolor": SKY_BLUE, "linewidth": 0.8}, medianprops={"color": "black"}, flierprops={"markersize": 3})
        axis.grid(visible=False, axis="x")
        axis.set_xlabel("characteristics changed")
        axis.set_ylabel(f"critical solutions per run\n({group['run'].nunique()} runs)")
        axis.set_title(escape_dollars(case.name) if len(cases) > 1 else "", fontsize=FONT)
        _set_integer_ticks(axis.yaxis)
    return _add_space(figure)


def draw_changed_characteristics(case: Case) -> Figure:
    """RQ3.2 as a heat map: the share of critical solutions with j changed characteristics in which each characteristic is changed."""
    import seaborn as sns

    _count_critical_solutions(case)
    shares = rq32(case)
    order = shares[shares["j"] == ANY].sort_values("rank", kind="stable")["characteristic"]
    shares_by_number = shares.pivot(index="characteristic", columns="j", values="percent").astype(float)
    shares_by_number = shares_by_number.loc[order, list(dict.fromkeys(shares["j"]))].rename(index=escape_dollars)
    title = f"{case.name}: characteristics changed in critical solutions"
    figure, ((axis,),) = new_figure(title, rows=1, columns=1, size=(7.6, 1.4 + 0.3 * len(shares_by_number)))
    sns.heatmap(shares_by_number, ax=axis, cmap="cividis", vmin=0, vmax=100, annot=True, fmt=".0f", annot_kws={"fontsize": 7},
                linewidths=0.5, cbar_kws={"label": "critical solutions\nin which it is changed [%]"})
    axis.grid(visible=False)
    colour_bar = axis.collections[0].colorbar.ax
    colour_bar.tick_params(labelsize=FONT)
    colour_bar.yaxis.label.set_size(FONT)
    axis.set_xlabel("number of characteristics changed (empty: no such solution)")
    axis.set_ylabel("characteristic, most frequent first")
    axis.tick_params(axis="both", length=0, rotation=0)
    return _add_space(figure)


def draw_change_sizes(case: Case) -> Figure:
    """The distribution of each characteristic's signed changes in the critical solutions."""
    import seaborn as sns

    solution_count = _count_critical_solutions(case)
    changes = list_changes(case)
    characteristics = case.characteristics.members
    title = f"{case.name}: changes in critical solutions"
    figure, axes = new_panels(title, len(characteristics), max_columns=4, panel_size=(2.25, 1.85), min_width=9.0, title_height=1.0)
    for axis, characteristic in zip(axes, characteristics, strict=True):
        change = changes.loc[changes["characteristic"] == characteristic.name, "change"]
        low, high = (float(f"{end - characteristic.original:.9g}") for end in (characteristic.lower, characteristic.upper))
        changes_by_colour = {INCREASE_COLOUR: change[change > 0], DECREASE_COLOUR: change[change < 0]}
        for colour, values in changes_by_colour.items():
            if len(values):
                end = high if colour == INCREASE_COLOUR else low
                edges = np.sort(np.linspace(0, end, 1 + max(1, round(BIN_COUNT * abs(end) / (high - low)))))
                sns.histplot(x=values, ax=axis, bins=edges, color=colour, edgecolor="white", linewidth=0.3, alpha=1)
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set_xlim(low, high)
        font_size = min(FONT, FONT * LONGEST_NAME / len(characteristic.name))
        counts = f"+{len(changes_by_colour[INCREASE_COLOUR])}, -{len(changes_by_colour[DECREASE_COLOUR])}"
        axis.set_title(f"{escape_dollars(characteristic.name)}\n{counts}", fontsize=font_size)
        axis.set_xlabel(f"change [{as_formula(characteristic.unit)}]", fontsize=FONT)
        axis.set_ylabel("")
        axis.locator_params(axis="x", nbins=3, steps=[1, 2, 5, 10])
        _set_integer_ticks(axis.yaxis, 4)
    figure.supylabel(f"number of critical solutions (of {solution_count})", fontsize=9)
    figure.supxlabel("orange, right of 0: increases; blue, left of 0: decreases; titles count them;\n"
                     "each axis spans the characteristic's domain", fontsize=FONT)
    return _add_space(figure)


def draw_pareto_fronts(case: Case) -> Figure:
    """The non-dominated solutions of all runs of each algorithm together, for every pair of objectives.

    Each panel also shows the original vehicle; solutions on the dashed line or to its left are collisions.

    Raises
    ------
    UnanswerableError
        If there is no solution.
    """
    objectives = case.scoring.objectives
    signs = [objective.sign for objective in objectives]
    fronts = {}
    for algorithm in case.algorithms:
        points = defined_minimised_values(case, case.solutions_of(algorithm))
        if len(points):
            fronts[algorithm] = nondominated_points(points) * signs
    if not fronts:
        raise UnanswerableError(case.name, "has no solution", "results with at least one finished run")
    pairs = list(combinations(range(len(objectives)), 2))
    rows = next(rows for rows in (5, 2, 1) if len(pairs) % (3 * rows) == 0 or rows == 1)
    columns = len(pairs) // rows
    figure, axes = new_figure(f"{case.name}: non-dominated solutions of each algorithm, all runs together", rows, columns,
                           (max(3.2 * columns, 5), 3.7 * rows))
    original = [_original_value(case, objective) for objective in objectives]
    for axis, (first, second) in zip(axes.flat, pairs, strict=True):
        for i, (algorithm, points) in enumerate(fronts.items()):
            axis.plot(points[:, first], points[:, second], linestyle="", marker=MARKERS[i % len(MARKERS)], markersize=4, alpha=0.6,
                      markeredgewidth=0, color=COLOURS[i % len(COLOURS)], label=f"{_algorithm_title(algorithm)} ({len(points)})")
        if not np.isnan([original[first], original[second]]).any():
            axis.plot(original[first], original[second], linestyle="", marker="*", markersize=9, color="black", label="original vehicle")
        if objectives[first] == F_SAFE:
            axis.axvline(0, color="black", linewidth=0.8, linestyle="--", label="collision: 0 or less")
        axis.set_xlabel(objective_title(objectives[first]))
        axis.set_ylabel(objective_title(objectives[second]))
    add_legend_below(figure, axes.flat[0])
    return _add_space(figure)


def objective_title(objective: Objective) -> str:
    return OBJECTIVE_TITLES.get(objective.name) or f"{escape_dollars(objective.title)} [{as_formula(objective.unit)}]"


def _original_value(case: Case, objective: Objective) -> float:
    """The original vehicle's value of an objective; NaN if it is unknown."""
    if objective.name in (F_DIFF.name, F_NUM_DIFF.name):
        return 0.0
    return case.original.get(SAFETY_DEGREE if objective == F_SAFE else objective.name, np.nan)


def draw_convergence(case: Case) -> Figure:
    """Convergence: the hypervolume of all settings so far over the number of evaluations, as median and range over the runs."""
    growth = compute_convergence(case)
    figure, ((axis,),) = new_figure(f"{case.name}: convergence", rows=1, columns=1, size=(6.4, 4.0))
    for i, (algorithm, group) in enumerate(growth.groupby("algorithm", sort=False)):
        statistics = group.groupby("evaluations")["hypervolume"].agg(["min", "median", "max"])
        colour = COLOURS[i % len(COLOURS)]
        axis.fill_between(statistics.index, statistics["min"], statistics["max"], color=colour, alpha=0.12, linewidth=0)
        for edge in ("min", "max"):
            axis.plot(statistics.index, statistics[edge], color=colour, linestyle=DASHES[i % len(DASHES)], linewidth=0.6)
        axis.plot(statistics.index, statistics["median"], color=colour, linestyle=DASHES[i % len(DASHES)], linewidth=1.8,
                  label=f"{_algorithm_title(str(algorithm))} ({group['run'].nunique()} runs)")
    axis.set_xlabel("evaluations")
    axis.set_ylabel(f"normalised hypervolume of all settings so far\n"
                    f"(thick: median, thin: range over runs; reference point {REFERENCE_COORDINATE:g})")
    add_legend_below(figure, axis)
    return _add_space(figure)


def _add_space(figure: Figure) -> Figure:
    """The figure, with space between its axes."""
    figure.set_layout_engine("constrained", w_pad=0.1)
    return figure


def add_legend_below(figure: Figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 3), frameon=False, fontsize=FONT)


def _count_critical_solutions(case: Case) -> int:
    """Number of critical solutions; raises UnanswerableError if there are none."""
    count = len(critical_solutions(case))
    if not count:
        raise UnanswerableError(case.name, "has no critical solution", "results with solutions that are more unsafe than the original")
    return count


def _set_integer_ticks(axis: object, steps: int = 6) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(steps, integer=True, min_n_ticks=1))  # type: ignore[attr-defined]


def _algorithm_title(algorithm: str) -> str:
    return escape_dollars(ALGORITHM_TITLES.get(algorithm, algorithm))
