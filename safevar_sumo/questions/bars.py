"""Draws limits: the domain of each characteristic is a bar, in which the limits are marked. A bar
is SVG on a page, block characters on the terminal, and a row of a figure.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from safevar_sumo.questions.answer import Answer

CELLS = 16
"""Width of a bar on the terminal [characters]."""
WIDTH, HEIGHT = 120, 14
"""Width and height of a bar on a page [px]."""
BAR_MARGIN = HEIGHT / 2
"""Room at each end of a bar, where the dot of the original may stand [px]."""
LEGEND = {
    "text": "bar: █ together, ▒ alone (all others as new), · domain, o original, | specified",
    "html": (
        "range: strong together, faint alone (all others as new), outline the domain, dot the"
        " original, tick the specified limit"
    ),
}


class Bar(NamedTuple):
    """The limits of a characteristic in its domain, as positions from 0 (lower end) to 1 (upper
    end).

    Attributes
    ----------
    original
        The original value.
    together, alone
        The joint limits, and the limits alone; () if there are none.
    specified
        The specified limits, at most two; () if there are none.
    """

    original: float
    together: tuple[float, ...]
    alone: tuple[float, ...]
    specified: tuple[float, ...]

    @property
    def blocks(self) -> str:
        """The bar in block characters. A range fills the cells whose middle is in the range."""
        middles = (np.arange(CELLS) + 0.5) / CELLS
        cells = np.full(CELLS, "·")
        for ends, letter in ((self.alone, "▒"), (self.together, "█")):
            if ends:
                cells[(middles >= ends[0]) & (middles <= ends[1])] = letter
        places = np.multiply([*self.specified, self.original], CELLS).astype(int)
        *limits, original = np.minimum(places, CELLS - 1)
        cells[limits] = "|"
        cells[original] = "o"
        return "".join(cells)

    @property
    def svg(self) -> str:
        """The bar as inline SVG. The page's style sheet gives the colours."""
        inside = WIDTH - 2 * BAR_MARGIN

        def x(share: float) -> str:
            """The horizontal position of a share [px]."""
            return f"{BAR_MARGIN + inside * share:.1f}"

        def rectangle(ends: tuple[float, ...], name: str) -> str:
            """A range as an SVG rectangle of the class `name`; "" for an empty range."""
            if not ends:
                return ""
            width = f"{max(inside * (ends[1] - ends[0]), 1):.1f}"
            return (
                f'<rect class="{name}" x="{x(ends[0])}" y="3" width="{width}"'
                f' height="{HEIGHT - 6}"/>'
            )

        # Later shapes cover earlier ones: ranges first, then the outline, limits and the original.
        shapes = rectangle(self.alone, "alone")
        shapes += rectangle(self.together, "together")
        shapes += rectangle((0, 1), "domain")
        for share in self.specified:
            shapes += f'<path class="tick" d="M{x(share)} 0v{HEIGHT}"/>'
        shapes += f'<circle cx="{x(self.original)}" cy="{HEIGHT / 2:g}" r="3"/>'
        size = f'width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}"'
        return f'<svg class="bar" {size} aria-hidden="true">{shapes}</svg>'


def bars_of(limits: pd.DataFrame, domains: Iterable[tuple[float, float]]) -> list[Bar]:
    """The bars of the rows of a table of limits. `domains` are the ends of the domain of each row's
    characteristic.
    """
    bars = []
    for row, (lower, upper) in zip(limits.to_dict("records"), domains, strict=True):
        ends = [row["original"]]
        for name in ("together", "alone", "specified"):
            ends += [row[f"{name}_low"], row[f"{name}_high"]]
        values = np.array(ends, dtype=float)
        original, *shares = np.clip((values - lower) / (upper - lower), 0, 1).tolist()
        pairs = zip(shares[::2], shares[1::2], strict=True)
        bars.append(
            Bar(original, *(tuple(filter(np.isfinite, pair)) for pair in pairs))
        )
    return bars


def draw_bars(answer: Answer) -> Figure:
    """Draw the bars of an answer's table of limits, a row for each characteristic."""
    from safevar_sumo.questions.figures import (
        BLUE,
        SKY_BLUE,
        VERMILION,
        escape_dollars,
        new_figure,
    )

    table = answer.tables.records["limits"]
    limits = table.frame
    size = (6.4, 1.3 + 0.3 * len(limits))
    figure, ((axis,),) = new_figure(f"{answer.study.name}: limits", 1, 1, size)
    for place, bar in enumerate(table.bars):
        for ends, colour in ((bar.alone, SKY_BLUE), (bar.together, BLUE)):
            if ends:
                axis.barh(
                    place, ends[1] - ends[0], height=0.6, left=ends[0], color=colour
                )
        axis.plot(bar.original, place, "o", color="black", markersize=4)
        axis.plot(
            bar.specified,
            [place] * len(bar.specified),
            "|",
            color=VERMILION,
            markersize=14,
        )
    axis.set_yticks(range(len(limits)), map(escape_dollars, limits["characteristic"]))
    axis.invert_yaxis()
    axis.set_xlim(-0.02, 1.02)
    axis.set_xlabel(
        "share of the domain; dark: limits of all together; light: limits alone (all others as new)"
        ";\ndot: the original vehicle; line: specified"
    )
    return figure
