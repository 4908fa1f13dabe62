"""Figures of RQ3: how many characteristics critical solutions change, which, and how much."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from matplotlib.ticker import MaxNLocator

from safevar_sumo.analysis.figures import (
    BLUE,
    FONT,
    SKY_BLUE,
    VERMILION,
    as_formula,
    escape_dollars,
    new_figure,
    new_panels,
)
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.changes import ANY, changes_of, critical_solutions, rq31, rq32

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST_NAME = 28
"""Number of letters of a name that fit above a small axis."""
PANELS_PER_ROW = 3
"""Number of panels in a row."""
BIN_COUNT = 24
"""Number of bins over a characteristic's domain."""


def draw_change_counts(cases: Sequence[Case]) -> Figure:
    """RQ3.1: number of critical solutions of a run with j characteristics changed, as box plots over the runs; a panel
    per case.

    Raises
    ------
    UnanswerableError
        If `rq31` raises it for a case.
    """
    title = (f"{cases[0].name}: " if len(cases) == 1 else "") + "number of changed characteristics"
    figure, axes = new_panels(title, len(cases), PANELS_PER_ROW, (3.9, 3.3), min_width=6.4, title_height=0.5)
    for axis, case in zip(axes, cases, strict=True):
        counts = rq31(case)
        counts_by_number = {str(j): rows["count"].to_numpy() for j, rows in counts.groupby("j", sort=False)}
        axis.boxplot(
            list(counts_by_number.values()),
            tick_labels=list(counts_by_number),
            widths=0.8,
            patch_artist=True,
            boxprops={"facecolor": SKY_BLUE, "linewidth": 0.8},
            medianprops={"color": "black"},
            flierprops={"markersize": 3},
        )
        axis.grid(visible=False, axis="x")
        axis.set(
            xlabel="characteristics changed", ylabel=f"critical solutions per run\n({counts['run'].nunique()} runs)"
        )
        axis.set_title(escape_dollars(case.name) if len(cases) > 1 else "", fontsize=FONT)
        axis.yaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    return figure


def draw_changed_characteristics(case: Case) -> Figure:
    """RQ3.2 as a heat map: the share of critical solutions with j changed characteristics in which each characteristic
    is changed.
    """
    import seaborn as sns

    _count_critical_solutions(case)
    shares = rq32(case)
    order = shares[shares["j"] == ANY].sort_values("rank", kind="stable")["characteristic"]
    shares_by_number = shares.pivot(index="characteristic", columns="j", values="percent").astype(float)
    shares_by_number = shares_by_number.loc[order, list(dict.fromkeys(shares["j"]))].rename(index=escape_dollars)
    title = f"{case.name}: characteristics changed in critical solutions"
    figure, ((axis,),) = new_figure(title, rows=1, columns=1, size=(7.6, 1.4 + 0.3 * len(shares_by_number)))
    sns.heatmap(
        shares_by_number,
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
    axis.grid(visible=False)
    colour_bar = axis.collections[0].colorbar.ax
    colour_bar.tick_params(labelsize=FONT)
    colour_bar.yaxis.label.set_size(FONT)
    axis.set(
        xlabel="number of characteristics changed (empty: no such solution)",
        ylabel="characteristic, most frequent first",
    )
    axis.tick_params(axis="both", length=0, rotation=0)
    return figure


def draw_change_sizes(case: Case) -> Figure:
    """The distribution of each characteristic's signed changes in the critical solutions."""
    solution_count = _count_critical_solutions(case)
    title = f"{case.name}: changes in critical solutions"
    figure, axes = new_panels(title, len(case.characteristics), 4, (2.25, 1.85), min_width=9.0, title_height=1.0)
    changes_by_characteristic = changes_of(case, critical_solutions(case)).T
    for axis, characteristic, changes in zip(axes, case.characteristics, changes_by_characteristic, strict=True):
        low, high = (
            float(f"{end - characteristic.original:.9g}") for end in (characteristic.lower, characteristic.upper)
        )
        increases, decreases = changes[changes > 0], changes[changes < 0]
        axis.hist([increases, decreases], bins=BIN_COUNT, range=(low, high), color=[VERMILION, BLUE], stacked=True)
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set_xlim(low, high)
        axis.set_title(
            f"{escape_dollars(characteristic.name)}\n+{len(increases)}, -{len(decreases)}",
            fontsize=min(FONT, FONT * LONGEST_NAME / len(characteristic.name)),
        )
        axis.set_xlabel(f"change [{as_formula(characteristic.unit)}]", fontsize=FONT)
        axis.locator_params(axis="x", nbins=3, steps=[1, 2, 5, 10])
        axis.yaxis.set_major_locator(MaxNLocator(4, integer=True, min_n_ticks=1))
    figure.supylabel(f"number of critical solutions (of {solution_count})", fontsize=9)
    figure.supxlabel(
        "orange, right of 0: increases; blue, left of 0: decreases; titles count them;\n"
        "each axis spans the characteristic's domain",
        fontsize=FONT,
    )
    return figure


def _count_critical_solutions(case: Case) -> int:
    """Number of critical solutions; raises UnanswerableError if there are none."""
    count = len(critical_solutions(case))
    if not count:
        raise UnanswerableError(
            case.name, "has no critical solution", "results with solutions that are more unsafe than the original"
        )
    return count
