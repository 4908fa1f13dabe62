"""Charts as SVG to embed in the page: values show under the pointer, without a script."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from markupsafe import Markup, escape

WIDTH = 720
ROW = 26
"""Height of a bar's row."""
LABEL = 170
"""Width of the names on the left."""
RIGHT = 24


class Dot(NamedTuple):
    """A point of a scatter chart: its title, look and link."""

    x: float
    y: float
    title: str
    look: str
    link: str = ""


class Bar(NamedTuple):
    """A bar in a row, its ends as fractions of the row, its look and its title."""

    start: float
    end: float
    look: str
    title: str


def rows(description: str, names: Sequence[str], bars_of_rows: Sequence[Sequence[Bar]], marks: Sequence[float | None],
         ends: Sequence[tuple[str, str]]) -> Markup:
    """Rows of bars with a mark each; `description` is the chart in words, `ends` the texts at a row's left and right end."""
    parts, inside = [], WIDTH - LABEL - RIGHT
    for i, (name, bars, mark, (left, right)) in enumerate(zip(names, bars_of_rows, marks, ends, strict=True)):
        y = i * ROW * 1.6
        parts.append(_text(LABEL - 8, y + 17, name, "name"))
        parts.append(f'<rect class="track" x="{LABEL}" y="{y + 4:.1f}" width="{inside}" height="{ROW - 8}" rx="3"/>')
        for bar in bars:
            x, width = LABEL + inside * bar.start, max(inside * (bar.end - bar.start), 1.5)
            parts.append(f'<rect class="{bar.look}" x="{x:.1f}" y="{y + 4:.1f}" width="{width:.1f}" height="{ROW - 8}">'
                         f"<title>{escape(bar.title)}</title></rect>")
        if mark is not None:
            parts.append(f'<path class="mark" d="M{LABEL + inside * mark:.1f} {y:.1f}v{ROW}"/>')
        parts.append(_text(LABEL, y + ROW + 8, left, "end start"))
        parts.append(_text(WIDTH - RIGHT, y + ROW + 8, right, "end"))
    return _svg(description, ROW * 1.6 * len(names) + 4, parts)


def scatter(description: str, dots: Sequence[Dot], x_title: str, y_title: str, line: float | None, line_title: str) -> Markup:
    """A scatter chart with a level line; y points up."""
    height, left, bottom = 330, 62, 44
    xs, ys = [dot.x for dot in dots], [dot.y for dot in dots] + ([] if line is None else [line])
    x_scale, y_scale = _ticks(min([0.0, *xs]), max(xs)), _ticks(min(ys), max([0.0, *ys]))

    def across(x: float) -> float:
        return left + (WIDTH - left - RIGHT) * (x - x_scale[0]) / (x_scale[-1] - x_scale[0])

    def up(y: float) -> float:
        return height - bottom - (height - bottom - 14) * (y - y_scale[0]) / (y_scale[-1] - y_scale[0])

    parts = [f'<path class="grid" d="M{left} {up(y):.1f}H{WIDTH - RIGHT}"/>' + _text(left - 7, up(y) + 4, f"{y:g}", "end") for y in y_scale]
    parts += [f'<path class="grid" d="M{across(x):.1f} 14V{height - bottom}"/>' + _text(across(x), height - bottom + 17, f"{x:g}", "middle")
              for x in x_scale]
    parts += [_text((WIDTH + left) / 2, height - 8, x_title, "middle title"),
              f'<g transform="translate(14 {(height - bottom) / 2}) rotate(-90)">{_text(0, 0, y_title, "middle title")}</g>']
    if line is not None:
        parts += [f'<path class="level" d="M{left} {up(line):.1f}H{WIDTH - RIGHT}"/>',
                  _text(WIDTH - RIGHT, up(line) - 5, line_title, "end")]
    for dot in dots:
        place = f'cx="{across(dot.x):.1f}" cy="{up(dot.y):.1f}"'
        drawn = f'<circle class="{dot.look}" {place} r="4.5"><title>{escape(dot.title)}</title></circle>'
        parts.append(f'<a href="#{escape(dot.link)}" aria-label="{escape(dot.title)}">{drawn}</a>' if dot.link else drawn)
    return _svg(description, height, parts, role="group" if any(dot.link for dot in dots) else "img")


def _svg(description: str, height: float, parts: Sequence[str], role: str = "img") -> Markup:
    """A chart of these parts, which must be escaped already."""
    return Markup(f'<svg class="chart" role="{role}" viewBox="0 0 {WIDTH} {height:.0f}" aria-label="{escape(description)}">\n'
                  + "\n".join(parts) + "\n</svg>")


def _text(x: float, y: float, words: Any, look: str) -> str:
    return f'<text class="{look}" x="{x:.1f}" y="{y:.1f}">{escape(words)}</text>'


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers that span from low to high."""
    from matplotlib.ticker import MaxNLocator

    ticks = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high if high > low else low + 1)
    return [round(float(tick), 10) for tick in ticks]
