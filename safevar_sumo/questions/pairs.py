"""The table and the figure of settings that were simulated in two versions A and B: in which
version a setting is unsafe, and its safety degree in both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.records import Evaluations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIDES = ["a", "b"]
UNSAFE_IN = {
    "a": "only_a_unsafe",
    "b": "only_b_unsafe",
    "both": "both",
    "neither": "neither",
}
"""By the versions in which a setting is unsafe, as the table states them, the name of the number
that counts such settings.
"""
SETTING_COLUMNS = shipped_columns("compare")["settings"]
ENDS = [name for name in SETTING_COLUMNS if name.startswith(("a_", "b_"))]


Criteria = Sequence[Unsafe]
Runs = Sequence[Evaluations]
Titles = Mapping[str, str]
"""The criteria of A and B; the evaluations of settings in A and in B; the names of A and B."""


def table_of_pairs(
    solutions: pd.Series[str], runs: Runs, criteria: Criteria
) -> pd.DataFrame:
    """The frame with `SETTING_COLUMNS` for settings that were evaluated in A and in B. `runs` and
    `criteria` have the evaluations and the criterion of each version.
    """
    a, b = runs
    in_a, in_b = (unsafe.of(run) for unsafe, run in zip(criteria, runs, strict=True))
    *versions, neither = UNSAFE_IN
    where = np.select([in_a & ~in_b, in_b & ~in_a, in_a & in_b], versions, neither)
    values = (solutions, where, a.outcome, a.f_safe, b.outcome, b.f_safe)
    return pd.DataFrame(dict(zip(SETTING_COLUMNS, values, strict=True)))


def counts_of(settings: pd.DataFrame) -> dict[str, int]:
    """The numbers of settings that are unsafe in A only, in B only, in both and in neither."""
    counts = Counter(settings["unsafe_in"])
    return {number: counts[where] for where, number in UNSAFE_IN.items()}


def draw_pairs(answer: Answer, titles: Sequence[str]) -> Figure:
    """Draw the safety degree of every setting in B over its safety degree in A. Both are equal on
    the line.
    """
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        GREY,
        SKY_BLUE,
        VERMILION,
        escape_dollars,
        new_figure,
    )

    frame = answer.tables["settings"]
    figure, ((axis,),) = new_figure(
        f"Unsafe means: {answer.numbers['unsafe']}", 1, 1, (4.6, 4.0)
    )
    for where, colour in {
        "neither": GREY,
        "both": SKY_BLUE,
        "a": BLUE,
        "b": VERMILION,
    }.items():
        rows = frame[frame["unsafe_in"] == where]
        axis.scatter(
            rows["a_degree"],
            rows["b_degree"],
            s=6,
            color=colour,
            label=where,
            rasterized=True,
        )

    axis.axline((0, 0), slope=1, color="black", linewidth=0.6)
    label_of_a, label_of_b = (
        escape_dollars(f"safety degree in {name} [m, below 0: -m/s]") for name in titles
    )
    axis.set(xlabel=label_of_a, ylabel=label_of_b)
    axis.legend(title="unsafe in version", fontsize=FONT_SIZE - 1)
    return figure
