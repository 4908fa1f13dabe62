"""The picture of a rating: the matrices of all tests with the colours of their cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from safevar_sumo.protocol import COLOURS, CellMatrix, Protocol
from safevar_sumo.protocol.cells import EXTENDED
from safevar_sumo.protocol.rater import Points
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.figures import FONT_SIZE, escape_dollars, new_panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw(protocol: Protocol, scores: Points, answer: Answer) -> Figure:
    """The matrices of all tests with the colours of their cells, of the original and its variant
    side by side.
    """
    # Points of each vehicle as title.
    vehicles = answer.tables["vehicles"]
    points = "; ".join(
        f"{name}: {total:.2f} points"
        for name, total in zip(vehicles["variant"], vehicles["points"], strict=True)
    )
    arrangement = " (original left, variant right)" if len(vehicles) > 1 else ""
    title = f"{answer.study.name}: {points} of {answer.numbers['possible']:g}{arrangement}"
    figure, axes = new_panels(
        title, len(protocol.matrices), 4, (3.75, 2.6), min_width=15.0, title_height=0.0
    )

    # A panel for each matrix.
    for axis, matrix in zip(axes, protocol.matrices, strict=True):
        _draw_matrix(axis, protocol, scores, matrix)
    legend = (
        ", ".join(f"{colour[0].upper()} {colour}" for colour in COLOURS)
        + "; small letters: extended range"
    )
    figure.supxlabel(
        "impact location [% of the width], or speed of the target [km/h] in CCCscp and CMCscp;"
        f" {legend}; asterisk: colour differs from the original's",
        fontsize=FONT_SIZE,
    )
    figure.supylabel("speed of the vehicle under test [km/h]", fontsize=FONT_SIZE)
    return figure


def _draw_matrix(axis: Axes, protocol: Protocol, scores: Points, matrix: CellMatrix) -> None:
    """Draw a matrix of every vehicle; each is followed by a gap, an empty column."""
    import seaborn as sns
    from matplotlib.colors import ListedColormap

    # Rows and columns, and the cell at each place.
    columns = [*(f"{value:g}" for value in matrix.impact_locations or matrix.target_speeds), ""]
    rows = [
        f"{row.vut_speed:g}{' FCW' * matrix.is_rated_by_warning(number)}"
        for number, row in enumerate(matrix.rows)
    ]
    known = protocol.matrix_cell_numbers
    numbers = np.array(
        [
            [known.get((matrix.name, row, column), -1) for column in range(len(columns))]
            for row in range(len(rows))
        ]
    )

    # Colours, with a letter for each.
    is_extended = np.array([cell.range_or_layer == EXTENDED for cell in protocol.cells])
    colours = [np.where(numbers < 0, np.nan, of_vehicle[numbers]) for of_vehicle in scores.colours]
    letters = []
    for of_vehicle in scores.colours:
        plain = np.array([*(colour[0] for colour in COLOURS), "?"])[of_vehicle]
        cased = np.where(is_extended, plain, np.char.upper(plain))
        marked = np.char.add(cased, np.where(of_vehicle != scores.colours[0], "*", ""))
        letters.append(np.where(numbers < 0, "", marked[numbers]))

    # All vehicles beside each other.
    frame = pd.DataFrame(np.hstack(colours), rows, columns * len(colours))
    palette = ListedColormap(["#808080", *(f"#{protocol.colours[colour]}" for colour in COLOURS)])
    limits = {"vmin": -1, "vmax": len(COLOURS) - 1}
    sns.heatmap(
        frame,
        annot=np.hstack(letters),
        fmt="",
        cmap=palette,
        **limits,
        cbar=False,
        linewidths=0.6,
        ax=axis,
    )
    axis.grid(False)
    axis.tick_params(labelsize=FONT_SIZE - 2, length=0, rotation=0)
    totals = " / ".join(f"{total:.2f}" for total in scores.tests[matrix.name].sum(axis=1))
    axis.set_title(
        escape_dollars(f"{matrix.name}: {totals} of {sum(matrix.points):g}"), fontsize=FONT_SIZE
    )
