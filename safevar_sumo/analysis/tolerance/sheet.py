"""The limits sheet: what a workshop needs to know of each characteristic, in its unit and rounded to the safe side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, VERMILION, as_formula, escape_dollars, new_figure
from safevar_sumo.analysis.research_questions.tables import LATEX_NEEDS, Table, markdown_table, render_latex
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import KMH_PER_MS, Evaluations, JsonObject
from safevar_sumo.scenarios import Point, distance_in_words
from safevar_sumo.study import Limit
from safevar_sumo.terminal import WholeTable
from safevar_sumo.vehicles import Characteristic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Ends = tuple[float | None, float | None]
"""A lower and an upper limit; None where there is none."""
NONE = "-"


class Failure(NamedTuple):
    """What fails first beyond a limit: the test point ("" without a matrix), the outcome, and both in words."""

    point: str
    outcome: str
    description: str
    alone: bool

    @classmethod
    def of(cls, run: Evaluations, points: Sequence[Point], unsafe: Unsafe, alone: bool) -> Failure:
        """The failure of one unsafe evaluation, at its worst point; `alone` says that one characteristic is changed."""
        point = points[0] if run.worst_points is None else points[int(run.worst_points[0])]
        scenario, degree = point.scenario, float(run.f_safe[0])
        speed = "" if scenario.test_speed is None else f" at {KMH_PER_MS * scenario.test_speed:.3g} km/h"
        if unsafe.points is not None:
            return cls("", str(run.outcome[0]), f"the car {unsafe.in_words}", alone)
        if run.collided[0]:
            impact_speed = -KMH_PER_MS * degree  # nearly 0 at the limit itself: then it says nothing
            impact = "" if speed or impact_speed < 1 else f" with {impact_speed:.2g} km/h"
            text = f"the car hits {scenario.obstacle()}{speed or impact}"
        else:
            text = f"the car keeps only {distance_in_words(scenario, degree)} from {scenario.obstacle()}{speed}"
        return cls(point.name, str(run.outcome[0]), text, alone)


@dataclass(frozen=True, kw_only=True)
class LimitRow:
    """One characteristic: how far it may go `alone`, and `together` with all others at their limits.

    `specified` is the user's limit, None without one; `kept` whether the car is safe within it, alone and together;
    `margin` the way from it to the limit alone [unit].
    """

    characteristic: Characteristic
    alone: Ends
    together: Ends
    specified: Limit | None
    together_is_safe: bool
    first_failure: Failure | None

    @property
    def margin(self) -> float | None:
        limit, (low, high) = self.specified, self.alone
        if limit is None or low is None or high is None:
            return None
        ways = [] if limit.at_least is None else [limit.at_least - low]
        return min(ways if limit.at_most is None else [*ways, high - limit.at_most])

    @property
    def kept(self) -> bool:
        alone_is_safe = self.alone[0] is not None and (self.margin is None or self.margin >= 0)
        return self.specified is None or (alone_is_safe and self.together_is_safe)

    def to_dict(self) -> JsonObject:
        """A record of `tolerance --limits --json`."""
        limit, one, failure = self.specified or Limit(), self.characteristic, self.first_failure
        named = None if failure is None else {key: getattr(failure, key) for key in ("point", "outcome", "description")}
        return {
            "limit": {
                "characteristic": one.name,
                "unit": one.unit,
                "original": one.original,
                "alone": list(self.alone),
                "together": list(self.together),
                "specified": {"low": limit.at_least, "high": limit.at_most, "source": limit.source},
                "kept": self.kept,
                "margin": self.margin,
                "first_failure": named,
            }
        }

    def texts(self, ends: Ends) -> tuple[str, str]:
        """Two limits as text, rounded to the safe side; "" where the domain ends."""
        one = self.characteristic
        low, high = ends
        return (
            "" if low is None or low <= one.lower else safe_text(one, low, upwards=True),
            "" if high is None or high >= one.upper else safe_text(one, high, upwards=False),
        )

    def in_words(self, ends: Ends) -> str:
        """Two limits in words: `from 2.32 mm`, `1 to 2 s`, `no limit found`."""
        low, high = self.texts(ends)
        if None in ends:
            return "nowhere safe"
        if low and high:
            return f"{low} to {high}{self.characteristic.suffix}"
        suffix = self.characteristic.suffix
        return f"from {low}{suffix}" if low else f"up to {high}{suffix}" if high else "whole domain"

    @property
    def verdict(self) -> str:
        """Whether the specified limit is kept, and the margin in words."""
        if self.specified is None:
            return NONE
        if self.margin is None or self.margin < 0:
            return "outside" if self.margin is None else f"outside by {-self.margin:.3g}{self.characteristic.suffix}"
        if not self.together_is_safe:
            return "inside alone, not together"
        return f"inside, margin {self.margin:.3g}{self.characteristic.suffix}"

    @property
    def sentence(self) -> str:
        """A sentence for a maintenance manual."""
        one, failure = self.characteristic, self.first_failure
        name = one.short_name[:1].upper() + one.short_name[1:]
        if None in self.alone:
            return f"{name}: the car is unsafe as new."
        if failure is None:
            return f"{name}: nothing in {one.lower:g} to {one.upper:g}{one.suffix} is unsafe alone."
        low, high = self.texts(self.alone if failure.alone else self.together)
        keep = " and ".join(
            f"{word} {text}{one.suffix}" for word, text in (("at least", low), ("at most", high)) if text
        )
        others = "" if failure.alone else " with the other characteristics at their limits,"
        return f"{name}: keep {keep or f'{one.original:g}{one.suffix}'}; beyond,{others} {failure.description}."


def safe_text(characteristic: Characteristic, value: float, *, upwards: bool) -> str:
    """A limit as text, rounded upwards or downwards; never beyond the original."""
    digits = len(characteristic.text(value).partition(".")[2])
    scaled, original = value * 10**digits, characteristic.original
    rounded = (math.ceil(scaled - 1e-6) if upwards else math.floor(scaled + 1e-6)) / 10**digits
    return (
        f"{original:g}"
        if (rounded > original >= value if upwards else rounded < original <= value)
        else f"{rounded:.{digits}f}"
    )


@dataclass(frozen=True)
class LimitsSheet:
    """The limits of all characteristics; `subject` names the study."""

    subject: str
    rows: Sequence[LimitRow]

    def to_frame(self) -> pd.DataFrame:
        """One row for each characteristic, limits as text rounded to the safe side."""
        return pd.DataFrame(
            [
                {
                    "characteristic": row.characteristic.short_name,
                    "part": row.characteristic.counterpart or NONE,
                    "new": f"{row.characteristic.original:g}{row.characteristic.suffix}",
                    "limit alone": row.in_words(row.alone),
                    "limit with all others at theirs": row.in_words(row.together),
                    "specified": self._specified(row),
                    "kept": row.verdict,
                    "fails first": NONE if row.first_failure is None else row.first_failure.description,
                }
                for row in self.rows
            ]
        )

    @staticmethod
    def _specified(row: LimitRow) -> str:
        limit = row.specified
        if limit is None:
            return NONE
        source = f" ({limit.source})" if limit.source else ""
        sides = (("from", limit.at_least), ("up to", limit.at_most))
        return (
            " ".join(f"{word} {value:g}" for word, value in sides if value is not None)
            + row.characteristic.suffix
            + source
        )

    def render(self, format_name: str) -> str:
        """The sheet as csv, markdown or latex."""
        frame = self.to_frame()
        if format_name == "csv":
            return str(frame.to_csv(index=False, lineterminator="\n"))
        if format_name == "markdown":
            return markdown_table([list(frame.columns), *frame.to_numpy().tolist()], 2) + "\n"
        table = Table(f"Limits: {self.subject}", frame.set_index("characteristic"))
        return f"{LATEX_NEEDS}\n{render_latex(table, 'limits')}"

    def to_dict(self) -> list[JsonObject]:
        """The records of `tolerance --limits --json`, one for each characteristic."""
        return [row.to_dict() for row in self.rows]

    def table(self) -> WholeTable:
        """The sheet as a table for the terminal; columns without any entry are left out."""
        frame = self.to_frame().drop(columns=["part", "fails first"])
        frame = frame[[name for name in frame if (frame[name] != NONE).any()]]
        heads = {"limit alone": "alone", "limit with all others at theirs": "all at limits"}
        title = "Limits of each alone, and of all at their limits, rounded to the safe side"
        table = WholeTable(*frame.rename(columns=heads).columns, title=title)
        for cells in frame.itertuples(index=False):
            table.add_row(*cells)
        return table

    def sentences(self) -> Iterator[str]:
        """A sentence for each characteristic, for a maintenance manual."""
        yield from (row.sentence for row in self.rows)

    def figure(self) -> Figure:
        """A bar for each characteristic from the original to its limits, with their values."""
        height = 0.9 + 0.55 * len(self.rows)
        figure, axes = new_figure(f"{self.subject}: limits, rounded to the safe side", 1, 1, (7.2, height))
        axis = axes[0, 0]
        for position, row in enumerate(self.rows):
            _draw_row(axis, -position, row)
        axis.set_yticks([-i for i in range(len(self.rows))])
        axis.set_yticklabels([escape_dollars(row.characteristic.short_name) for row in self.rows], fontsize=FONT_SIZE)
        axis.set_xlim(-0.02, 1.02)
        axis.set_ylim(0.5 - len(self.rows), 0.5)
        axis.set_xticks([])
        axis.set_xlabel(
            "domain from its lower to its upper end; dot: new; line: specified;\n"
            "light: safe alone; dark: safe with all others at theirs",
            fontsize=FONT_SIZE - 1,
        )
        return figure


def _draw_row(axis: Axes, height: float, row: LimitRow) -> None:
    """The bars of one characteristic, over its domain from 0 to 1, with the values at their ends."""
    one = row.characteristic

    def place(value: float) -> float:
        return (value - one.lower) / (one.upper - one.lower)

    axis.plot([0, 1], [height, height], color="0.8", linewidth=1, zorder=1)
    for (low, high), style in ((row.alone, {"linewidth": 11, "alpha": 0.35}), (row.together, {"linewidth": 5})):
        if low is not None and high is not None:
            axis.plot([place(low), place(high)], [height, height], color=BLUE, solid_capstyle="butt", zorder=2, **style)
    for ends, offset in ((row.alone, 0.2), (row.together, -0.36)):
        if None in ends or (ends == row.together and row.together == row.alone):
            continue
        for text, value, side in zip(row.texts(ends), ends, ("left", "right"), strict=True):
            if text and value is not None:
                axis.text(
                    place(value), height + offset, f"{text}{as_formula(one.suffix)}", ha=side, fontsize=FONT_SIZE - 1.5
                )
    for limit in () if row.specified is None else (row.specified.at_least, row.specified.at_most):
        if limit is not None:
            axis.plot([place(limit)] * 2, [height - 0.3, height + 0.3], color=VERMILION, linewidth=1.5, zorder=3)
    axis.plot(place(one.original), height, marker="o", color="black", markersize=4, zorder=4)
