"""Charts as SVG to embed in the page; without a script, values appear when the pointer rests on a shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from markupsafe import Markup, escape

WIDTH = 720
ROW_HEIGHT = 26
"""Height of a row of bars [pixels]."""
ROW_PITCH = ROW_HEIGHT * 1.6
"""Distance from one row of bars to the next, with the texts between them [pixels]."""
NAME_WIDTH = 170
"""Width of the column of names at the left [pixels]."""
RIGHT_MARGIN = 24
DOT_RADIUS, CHARACTER_WIDTH, TEXT_HEIGHT = 4.5, 6.5, 10.0
"""Sizes of a dot and of a text [pixels]."""


class Dot(NamedTuple):
    """A point of a scatter chart: its coordinates, tooltip, CSS class and link."""

    x: float
    y: float
    tooltip: str
    css_class: str
    link: str = ""


class Bar(NamedTuple):
    """A bar in a row: its ends as fractions of the row, its CSS class and its tooltip."""

    start: float
    end: float
    css_class: str
    tooltip: str


def draw_bars(description: str, names: Sequence[str], bars_of_rows: Sequence[Sequence[Bar]],
              mark_positions: Sequence[float | None], end_labels: Sequence[tuple[str, str]]) -> Markup:
    """Draw rows of bars; `description` is the chart in words, `end_labels` are the texts below the left and right end of each row.

    `mark_positions` has the position of a vertical mark in each row, such as the original value, as a fraction of the row.
    """
    elements, track_width = [], WIDTH - NAME_WIDTH - RIGHT_MARGIN
    for row_number, (name, bars, mark_position, (left_label, right_label)) in enumerate(
            zip(names, bars_of_rows, mark_positions, end_labels, strict=True)):
        y = row_number * ROW_PITCH
        elements.append(_text(NAME_WIDTH - 8, y + 17, name, "name"))
        elements.append(f'<rect class="track" x="{NAME_WIDTH}" y="{y + 4:.1f}" width="{track_width}" height="{ROW_HEIGHT - 8}" rx="3"/>')
        for bar in bars:
            x, width = NAME_WIDTH + track_width * bar.start, max(track_width * (bar.end - bar.start), 1.5)
            elements.append(f'<rect class="{bar.css_class}" x="{x:.1f}" y="{y + 4:.1f}" width="{width:.1f}" height="{ROW_HEIGHT - 8}">'
                         f"<title>{escape(bar.tooltip)}</title></rect>")
        if mark_position is not None:
            elements.append(f'<path class="mark" d="M{NAME_WIDTH + track_width * mark_position:.1f} {y:.1f}v{ROW_HEIGHT}"/>')
        elements.append(_text(NAME_WIDTH, y + ROW_HEIGHT + 8, left_label, "anchor-start"))
        elements.append(_text(WIDTH - RIGHT_MARGIN, y + ROW_HEIGHT + 8, right_label, "anchor-end"))
    return _svg(description, ROW_PITCH * len(names) + 4, elements)


def draw_scatter(description: str, dots: Sequence[Dot], x_title: str, y_title: str, line: float | None, line_title: str) -> Markup:
    """Draw a scatter chart; `line` is the y of a horizontal line, if any."""
    height, left_margin, bottom_margin = 330, 62, 44
    xs, ys = [dot.x for dot in dots], [dot.y for dot in dots] + ([] if line is None else [line])
    x_ticks, y_ticks = _ticks(min([0.0, *xs]), max(xs)), _ticks(min(ys), max([0.0, *ys]))

    def pixel_x(x: float) -> float:
        return left_margin + (WIDTH - left_margin - RIGHT_MARGIN) * (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])

    def pixel_y(y: float) -> float:
        return height - bottom_margin - (height - bottom_margin - 14) * (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0])

    elements = [f'<path class="grid" d="M{left_margin} {pixel_y(y):.1f}H{WIDTH - RIGHT_MARGIN}"/>'
             + _text(left_margin - 7, pixel_y(y) + 4, f"{y:g}", "anchor-end") for y in y_ticks]
    elements += [f'<path class="grid" d="M{pixel_x(x):.1f} 14V{height - bottom_margin}"/>'
              + _text(pixel_x(x), height - bottom_margin + 17, f"{x:g}", "anchor-middle")
              for x in x_ticks]
    elements += [_text((WIDTH + left_margin) / 2, height - 8, x_title, "anchor-middle title"),
              f'<g transform="translate(14 {(height - bottom_margin) / 2}) rotate(-90)">{_text(0, 0, y_title, "anchor-middle title")}</g>']
    if line is not None:
        elements.append(f'<path class="level" d="M{left_margin} {pixel_y(line):.1f}H{WIDTH - RIGHT_MARGIN}"/>')
    for dot in dots:
        centre = f'cx="{pixel_x(dot.x):.1f}" cy="{pixel_y(dot.y):.1f}"'
        circle = f'<circle class="{dot.css_class}" {centre} r="{DOT_RADIUS}"><title>{escape(dot.tooltip)}</title></circle>'
        elements.append(f'<a href="#{escape(dot.link)}" aria-label="{escape(dot.tooltip)}">{circle}</a>' if dot.link else circle)
    if line is not None:
        centres = [(pixel_x(dot.x), pixel_y(dot.y)) for dot in dots]
        x, y = _free_place(centres, line_title, left_margin, pixel_y(line), height - bottom_margin)
        elements.append(_text(x, y, line_title, "anchor-end on-paper"))
    return _svg(description, height, elements, role="group" if any(dot.link for dot in dots) else "img")


def _free_place(dots: Sequence[tuple[float, float]], text: str, left: float, line: float, bottom: float) -> tuple[float, float]:
    """The right end, as far right as possible, of a text above or below a horizontal line, where it covers the fewest dots [pixels]."""
    width = CHARACTER_WIDTH * len(text)

    def count_covered(place: tuple[float, float]) -> int:
        right, base = place[0] + DOT_RADIUS, place[1] + DOT_RADIUS
        return sum(right - width - 2 * DOT_RADIUS < x < right and base - TEXT_HEIGHT - 2 * DOT_RADIUS < y < base for x, y in dots)

    heights = [line - DOT_RADIUS, *([line + TEXT_HEIGHT + DOT_RADIUS] if line + TEXT_HEIGHT + DOT_RADIUS < bottom else [])]
    right_ends = range(WIDTH - RIGHT_MARGIN, math.ceil(left + width), -10)
    return min(((float(x), y) for x in right_ends for y in heights), key=count_covered)


def _svg(description: str, height: float, elements: Sequence[str], role: str = "img") -> Markup:
    """Put SVG elements into a chart; their texts must be escaped already."""
    return Markup(f'<svg class="chart" role="{role}" viewBox="0 0 {WIDTH} {height:.0f}" aria-label="{escape(description)}">\n'
                  + "\n".join(elements) + "\n</svg>")


def _text(x: float, y: float, words: Any, css_class: str) -> str:
    return f'<text class="{css_class}" x="{x:.1f}" y="{y:.1f}">{escape(words)}</text>'


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers for an axis, from at most `low` to at least `high`."""
    from matplotlib.ticker import MaxNLocator

    ticks = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high if high > low else low + 1)
    return [round(float(tick), 10) for tick in ticks]
