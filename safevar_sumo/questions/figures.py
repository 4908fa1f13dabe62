"""The style of all figures: readable in print and for colour-blind readers."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.output import WRITABLE, whole_file
from safevar_sumo.plugins.process import temporary_entries
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.records import JsonObject

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 200
PICTURE_METADATA: Mapping[str, JsonObject] = {
    ".pdf": {"CreationDate": None},
    ".svg": {"Date": None},
}
"""Metadata of pictures by file ending. They keep the date out of a file, so that equal figures have
equal bytes.
"""
TRUETYPE = 42
"""matplotlib's number for TrueType fonts in a pdf. Publishers refuse the default, Type 3."""
FONT_SIZE = 8
GREY, SKY_BLUE, BLUE, VERMILION = "#bbbbbb", "#56b4e9", "#0072b2", "#d55e00"
"""Grey and colours of Okabe and Ito. Grey and the two blues differ in lightness, so that they
differ in a print without colours too.
"""


@contextmanager
def own_style() -> Iterator[None]:
    """Within the block, matplotlib draws with its own defaults, whatever a file matplotlibrc, the
    environment or the user's code states. After the block, matplotlib's settings are as before.
    """
    _import_matplotlib()
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


def _import_matplotlib() -> None:
    """Import matplotlib, which raises an error if it cannot read the user's settings. It is then
    imported with its own settings.
    """
    try:
        import matplotlib
    except (ValueError, OSError):
        (folder,) = cast("Any", find_spec("matplotlib")).submodule_search_locations
        defaults = str(Path(folder, "mpl-data", "matplotlibrc"))
        # A part of matplotlib's modules may have been loaded before the error.
        for name in list(sys.modules):
            if name.partition(".")[0] == "matplotlib":
                del sys.modules[name]
        # Figures of this package need no window, and no other backend than this one.
        variables = {"MATPLOTLIBRC": defaults, "MPLBACKEND": "agg"}
        with temporary_entries(os.environ, variables):
            import matplotlib  # noqa: F401 - it reads `defaults`


def new_figure(
    title: str, rows: int, columns: int, size: Interval, **options: Any
) -> tuple[Figure, np.ndarray]:
    """A new figure and its axes, shape (rows, columns). pyplot does not know the figure, so that it
    need not be closed. `size` is in inches; `options` go to `Figure.subplots`.
    """
    import matplotlib.style
    from matplotlib.figure import Figure

    texts = (
        "font.size",
        "axes.labelsize",
        "axes.titlesize",
        "xtick.labelsize",
        "ytick.labelsize",
    )
    with matplotlib.style.context(
        ["seaborn-v0_8-whitegrid", dict.fromkeys(texts, FONT_SIZE)]
    ):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options)
    figure.suptitle(escape_dollars(title), fontsize=FONT_SIZE + 2)
    return figure, axes


def new_panels(
    title: str,
    number: int,
    max_columns: int,
    panel_size: Interval,
    min_width: float,
    title_height: float,
) -> tuple[Figure, list[Axes]]:
    """A new figure with `number` panels, at most `max_columns` of them side by side; and the axes
    of the panels. All sizes are in inches.
    """
    columns = min(max_columns, number)
    rows = math.ceil(number / columns)
    figure, axes = new_figure(
        title,
        rows,
        columns,
        (max(panel_size[0] * columns, min_width), title_height + panel_size[1] * rows),
    )
    for axis in axes.flat[number:]:
        axis.set_axis_off()
    return figure, list(axes.flat[:number])


@own_style()
def save(figure: Figure, path: Path, option: str = "out") -> None:
    """Write a figure to a png, pdf or svg file; the same figure gives the same bytes.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    import matplotlib

    try:
        with (
            matplotlib.rc_context(
                {"svg.hashsalt": "safevar_sumo", "pdf.fonttype": TRUETYPE}
            ),
            whole_file(path) as file,
        ):
            figure.savefig(
                file, dpi=DPI, metadata=PICTURE_METADATA.get(path.suffix.lower())
            )
    except (OSError, ValueError) as error:
        raise InputError(
            option,
            f"cannot write {path}: {getattr(error, 'strerror', None) or error}",
            f"{WRITABLE}; its name ends in .png, .pdf or .svg",
        ) from None


def escape_dollars(name: str) -> str:
    """A name with its dollar signs escaped, so that matplotlib does not read a formula in it."""
    return name.replace("$", r"\$")


def as_formula(unit: str) -> str:
    """A unit in which matplotlib draws powers as superscripts."""
    return re.sub(r"\^(-?\d+)", r"$^{\1}$", escape_dollars(unit))
