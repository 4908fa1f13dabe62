"""Pictures of the answers, readable in print and for colour-blind readers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.answers.findings import Explained
from safevar_sumo.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 200
FONT = 8
CHANGED, INVOLVED, NECESSARY = "#bbbbbb", "#56b4e9", "#0072b2"
"""Grey and Okabe and Ito's blues: of different lightness, so that they stay apart without colour."""


def necessity_figure(told: Explained) -> Figure:
    """How often each characteristic is necessary, beside how often it is changed (RQ3.2 asked again)."""
    frame = told.necessity.iloc[::-1]
    figure, ((axis,),) = new_figure(f"{told.study.name}: changed is not needed", 1, 1, (6.4, 1.4 + 0.3 * max(len(frame), 4)))
    names = [plain(name) for name in frame["characteristic"]]
    for column, label, colour, height in (
            ("changed", "changed", CHANGED, 0.8), ("involved", "in some minimal cause", INVOLVED, 0.5),
            ("necessary", "necessary: in every minimal cause", NECESSARY, 0.24)):
        axis.barh(names, 100 * frame[column], height=height, color=colour, label=label)
    axis.set_xlim(0, 100)
    axis.set_xlabel(f"share of {told.analysed} failures [%]")
    axis.grid(visible=False, axis="y")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=FONT)
    return figure


def new_figure(title: str, rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, np.ndarray]:
    """A figure that no global state knows of, and its axes, shape (rows, columns); `size` in inches."""
    import matplotlib.style
    from matplotlib.figure import Figure

    with matplotlib.style.context(["seaborn-v0_8-whitegrid", {"font.size": FONT, "axes.labelsize": FONT, "axes.titlesize": FONT,
                                                              "xtick.labelsize": FONT, "ytick.labelsize": FONT}]):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(plain(title), fontsize=FONT + 2)
    return figure, axes


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file: png, pdf or svg.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        figure.savefig(path, dpi=DPI)
    except OSError as error:
        raise InputError("--out", f"cannot write {path}: {error.strerror or error}", "a directory that can be written") from None


def plain(name: str) -> str:
    """A name in which matplotlib sees no formula."""
    return name.replace("$", r"\$")
