"""The style of all figures: readable in print and for colour-blind readers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 200
UNDATED: Mapping[str, dict[str, Any]] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
"""Metadata that leaves no date in a picture."""
FONT = 8
DEGREE = "safety degree [m]\n(below 0: minus the collision's speed [m/s])"
UNSAFE = "#d55e00"
CHANGED, INVOLVED, NECESSARY = "#bbbbbb", "#56b4e9", "#0072b2"
"""Grey and Okabe and Ito's blues: of different lightness, so that they stay apart without colour."""


def new_figure(title: str, rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, np.ndarray]:
    """A figure outside pyplot's state, and its axes, shape (rows, columns); `size` in inches, `options` of `Figure.subplots`."""
    import matplotlib.style
    from matplotlib.figure import Figure

    with matplotlib.style.context(["seaborn-v0_8-whitegrid", {"font.size": FONT, "axes.labelsize": FONT, "axes.titlesize": FONT,
                                                              "xtick.labelsize": FONT, "ytick.labelsize": FONT}]):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options)
    figure.suptitle(literal(title), fontsize=FONT + 2)
    return figure, axes


def panels(title: str, number: int, across: int, panel: tuple[float, float], least_width: float, above: float) -> tuple[Figure, list[Axes]]:
    """A figure with `number` panels of the size `panel`, at most `across` side by side, and the panels' axes.

    The figure is at least `least_width` wide, and its title takes the height `above`; all sizes in inches.
    """
    columns = min(across, number)
    rows = -(-number // columns)
    figure, axes = new_figure(title, rows, columns, (max(panel[0] * columns, least_width), above + panel[1] * rows))
    for unused in axes.flat[number:]:
        unused.set_axis_off()
    return figure, list(axes.flat[:number])


def save(figure: Figure, path: Path, source: str = "out") -> None:
    """Write a figure to a file: png, pdf or svg; the same figure gives the same bytes.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    import matplotlib

    try:
        with matplotlib.rc_context({"svg.hashsalt": "safevar_sumo"}):
            figure.savefig(path, dpi=DPI, metadata=UNDATED.get(path.suffix.lower()))
    except (OSError, ValueError) as error:
        raise InputError(source, f"cannot write {path}: {getattr(error, 'strerror', None) or error}",
                         "a file that ends in .png, .pdf or .svg, in a directory that can be written") from None


def literal(name: str) -> str:
    """A name, escaped so that matplotlib sees no formula in it."""
    return name.replace("$", r"\$")


def as_formula(unit: str) -> str:
    """A unit with its powers as superscripts."""
    return re.sub(r"\^(-?\d+)", r"$^{\1}$", literal(unit))
