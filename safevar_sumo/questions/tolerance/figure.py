"""The picture of limits: the safety degree, or points of a rating, over each domain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.study import SAFETY_DEGREE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_limits(answer: Answer, scans: Sequence[OneAtATimeScan]) -> Figure:
    """The safety degree, or points, over each domain; limits are marked."""
    from safevar_sumo.questions.figures import DEGREE_LABEL, FONT_SIZE, new_panels

    column = RATING_POINTS.name if is_rated(answer.study) else SAFETY_DEGREE
    title = (
        f"{answer.study.name}: one characteristic at a time (unsafe: {answer.numbers['unsafe']})"
    )
    figure, axes = new_panels(title, len(scans), 4, (2.3, 1.75), min_width=4.6, title_height=1.1)
    for axis, one, row in zip(axes, scans, answer.tables["limits"].to_dict("records"), strict=True):
        if axis is not axes[0]:
            axis.sharey(axes[0])  # so that steep profiles stand out
        _draw_profile(axis, one, row, column)
    figure.supylabel(
        DEGREE_LABEL if column == SAFETY_DEGREE else RATING_POINTS.title, fontsize=FONT_SIZE
    )
    dashed = "; below a dashed line: collisions" if column == SAFETY_DEGREE else ""
    ranges = "light: limits of all together;\nbar below: limits alone"
    marks = f"dot: the original vehicle; hatched: unsafe; {ranges}; line: specified"
    figure.supxlabel(f"{marks}{dashed}", fontsize=FONT_SIZE)
    return figure


def _draw_profile(axis: Axes, one: OneAtATimeScan, row: Mapping[Any, Any], column: str) -> None:
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        SKY_BLUE,
        VERMILION,
        as_formula,
        escape_dollars,
    )

    item = one.characteristic
    profile = one.profile.set_index("value")[column]
    axis.plot(profile, color=BLUE, linewidth=1.2)
    for low, high in one.of_state("unsafe"):
        axis.axvspan(
            low, high, facecolor=VERMILION, alpha=0.35, hatch="////", edgecolor="white", linewidth=0
        )
    if not pd.isna(row["together_low"]):
        axis.axvspan(
            row["together_low"], row["together_high"], facecolor=SKY_BLUE, alpha=0.25, linewidth=0
        )
    ends_alone = (row["alone_low"], row["alone_high"])
    axis.plot(
        ends_alone,
        (0.03, 0.03),
        transform=axis.get_xaxis_transform(),
        color=BLUE,
        linewidth=4,
        alpha=0.5,
    )
    for value in (row["specified_low"], row["specified_high"]):
        if not pd.isna(value):
            axis.axvline(value, color=VERMILION, linewidth=1.5)
    axis.plot(item.original, profile[item.original], marker="o", color="black", markersize=4)
    if column == SAFETY_DEGREE and profile.min() <= 0:
        axis.axhline(0, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlim(item.lower, item.upper)
    axis.set_title(escape_dollars(item.name), fontsize=FONT_SIZE)
    axis.set_xlabel(f"[{as_formula(item.unit)}]")
    axis.locator_params(axis="x", nbins=4)
