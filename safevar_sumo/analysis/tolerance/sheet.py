"""The limits sheet: what a workshop needs to know of each characteristic, in its unit and rounded to the safe side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Interval
from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, VERMILION, as_formula, escape_dollars, new_figure
from safevar_sumo.analysis.research_questions.formats import LATEX_NEEDS, markdown_table, render_latex
from safevar_sumo.analysis.research_questions.tables import Table
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import KMH_PER_MS, Evaluations, JsonObject
from safevar_sumo.scenarios import Point, distance_in_words
from safevar_sumo.study import Limit
from safevar_sumo.terminal import WholeTable
from safevar_sumo.vehicles import Characteristic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NONE = "-"
ROUNDING = 1e-6
"""Share of a text's last digit by which a value may be off its rounded one, from rounding errors."""


def describe_failure(run: Evaluations, points: Sequence[Point], unsafe: Unsafe) -> dict[str, str]:
    """An unsafe evaluation in words: the name of its worst point ("" without a matrix), its outcome, and a
    description.
    """
    point = points[0] if run.worst_points is None else points[int(run.worst_points[0])]
    scenario, degree = point.scenario, float(run.f_safe[0])
    speed = "" if scenario.test_speed is None else f" at {KMH_PER_MS * scenario.test_speed:.3g} km/h"
    name = point.name
    if unsafe.points is not None:  # points are of the whole matrix
        name, text = "", f"the car {unsafe.in_words}"
    elif run.collided[0]:
        impact_speed = -KMH_PER_MS * degree  # nearly 0 at the limit itself: then it says nothing
        impact = "" if speed or impact_speed < 1 else f" with {impact_speed:.2g} km/h"
        text = f"the car hits {scenario.obstacle()}{speed or impact}"
    else:
        text = f"the car keeps only {distance_in_words(scenario, degree)} from {scenario.obstacle()}{speed}"
    return {"point": name, "outcome": str(run.outcome[0]), "description": text}


@dataclass(frozen=True, kw_only=True)
class LimitRow:
    """How far one characteristic may go.

    Attributes
    ----------
    scan
        How far it may go alone.
    together
        How far it may go together with all others; None if nothing is safe, or no box was sought.
    specified
        The user's limit; None without one.
    together_is_safe
        Whether all specified limits can be reached together.
    first_failure
        What fails first beyond the limit, alone or else with the others at their limits (`describe_failure`).
    """

    scan: OneAtATimeScan
    together: Interval | None
    specified: Limit | None
    together_is_safe: bool
    first_failure: dict[str, str] | None

    @property
    def characteristic(self) -> Characteristic:
        return self.scan.characteristic

    @property
    def margin(self) -> float | None:
        """The way from the specified limit to the limit alone [unit]."""
        if self.specified is None or self.scan.safe is None:
            return None
        (low, high), limit = self.scan.safe, self.specified
        below = math.inf if limit.at_least is None else limit.at_least - low
        above = math.inf if limit.at_most is None else high - limit.at_most
        return min(below, above)

    @property
    def kept(self) -> bool:
        """Whether the car is safe within the specified limit, alone and together."""
        alone_is_safe = self.scan.safe is not None and (self.margin is None or self.margin >= 0)
        return self.specified is None or (alone_is_safe and self.together_is_safe)

    def to_dict(self) -> JsonObject:
        """A record of `tolerance --limits --json`."""
        limit, item = self.specified or Limit(), self.characteristic
        return {
            "limit": {
                "characteristic": item.name,
                "unit": item.unit,
                "original": item.original,
                "alone": list(self.scan.safe or (None, None)),
                "together": list(self.together or (None, None)),
                "specified": {"low": limit.at_least, "high": limit.at_most, "source": limit.source},
                "kept": self.kept,
                "margin": self.margin,
                "first_failure": self.first_failure,
            }
        }

    def texts(self, ends: Interval) -> tuple[str, str]:
        """The ends of an interval as text, rounded to the safe side; "" where the domain ends."""
        item, (low, high) = self.characteristic, ends
        return (
            "" if low <= item.lower else safe_text(item, low, upwards=True),
            "" if high >= item.upper else safe_text(item, high, upwards=False),
        )

    def in_words(self, ends: Interval | None) -> str:
        """An interval in words: `from 2.32 mm`, `1 to 2 s`, `whole domain`."""
        if ends is None:
            return "nowhere safe"
        low, high = self.texts(ends)
        if not low and not high:
            return "whole domain"
        text = f"{low} to {high}" if low and high else f"from {low}" if low else f"up to {high}"
        return f"{text}{self.characteristic.suffix}"

    @property
    def specified_in_words(self) -> str:
        """The specified limit with its source."""
        if self.specified is None:
            return NONE
        sides = (("from", self.specified.at_least), ("up to", self.specified.at_most))
        text = " ".join(f"{word} {value:g}" for word, value in sides if value is not None)
        source = f" ({self.specified.source})" if self.specified.source else ""
        return f"{text}{self.characteristic.suffix}{source}"

    @property
    def verdict(self) -> str:
        """Whether the specified limit is kept, and the margin in words."""
        if self.specified is None:
            return NONE
        if self.margin is None:
            return "outside"
        margin = f"{abs(self.margin):.3g}{self.characteristic.suffix}"
        if self.margin < 0:
            return f"outside by {margin}"
        return f"inside, margin {margin}" if self.together_is_safe else "inside alone, not together"

    @property
    def sentence(self) -> str:
        """A sentence for a maintenance manual."""
        item, failure, is_unsafe_alone = self.characteristic, self.first_failure, bool(self.scan.unsafe)
        name = item.short_name[:1].upper() + item.short_name[1:]
        ends = self.scan.safe if is_unsafe_alone else self.together
        if self.scan.safe is None:
            return f"{name}: the car is unsafe as new."
        if failure is None or ends is None:
            return f"{name}: nothing in {item.lower:g} to {item.upper:g}{item.suffix} is unsafe alone."
        words = zip(("at least", "at most"), self.texts(ends), strict=True)
        keep = " and ".join(f"{word} {text}{item.suffix}" for word, text in words if text)
        others = "" if is_unsafe_alone else " with the other characteristics at their limits,"
        return f"{name}: keep {keep or f'{item.original:g}{item.suffix}'}; beyond,{others} {failure['description']}."

    def draw(self, axis: Axes, height: float) -> None:
        """Draw a bar for the limits alone and one for those together, with values at their ends; 0 to 1 is the
        domain.
        """
        item, specified = self.characteristic, self.specified or Limit()
        domain = (item.lower, item.upper)
        axis.plot([0, 1], [height] * 2, color="0.8", linewidth=1, zorder=1)
        for ends, offset, width, alpha in ((self.scan.safe, 0.2, 11, 0.35), (self.together, -0.36, 5, 1.0)):
            if ends is None:
                continue
            places = np.interp(ends, domain, (0, 1))
            axis.plot(places, [height] * 2, color=BLUE, linewidth=width, alpha=alpha, solid_capstyle="butt", zorder=2)
            for text, place, side in zip(self.texts(ends), places, ("left", "right"), strict=True):
                if text and (offset > 0 or ends != self.scan.safe):  # the same values are not written twice
                    label = f"{text}{as_formula(item.suffix)}"
                    axis.text(place, height + offset, label, ha=side, fontsize=FONT_SIZE - 1.5)
        for value in (specified.at_least, specified.at_most):
            place = np.interp(math.nan if value is None else value, domain, (0, 1))
            axis.plot([place] * 2, [height - 0.3, height + 0.3], color=VERMILION, linewidth=1.5, zorder=3)
        axis.plot(np.interp(item.original, domain, (0, 1)), height, marker="o", color="black", markersize=4, zorder=4)


def safe_text(characteristic: Characteristic, value: float, *, upwards: bool) -> str:
    """A limit as text, rounded upwards or downwards; never beyond the original."""
    digits, original = len(characteristic.text(value).partition(".")[2]), characteristic.original
    scaled = value * 10**digits
    rounded = (math.ceil(scaled - ROUNDING) if upwards else math.floor(scaled + ROUNDING)) / 10**digits
    is_beyond = rounded > original >= value if upwards else rounded < original <= value
    return f"{original:g}" if is_beyond else f"{rounded:.{digits}f}"


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
                    "limit alone": row.in_words(row.scan.safe),
                    # No box of a rated study is sought.
                    "limit with all others at theirs": NONE if row.scan.points else row.in_words(row.together),
                    "specified": row.specified_in_words,
                    "kept": row.verdict,
                    "fails first": row.first_failure["description"] if row.first_failure else NONE,
                }
                for row in self.rows
            ]
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

    def parts(self) -> Iterator[WholeTable | str]:
        """The sheet as a table for the terminal, without columns that have no entry, and a sentence for each
        characteristic.
        """
        frame = self.to_frame().drop(columns=["part", "fails first"])
        frame = frame[[name for name in frame if (frame[name] != NONE).any()]]
        heads = {"limit alone": "alone", "limit with all others at theirs": "all at limits"}
        title = "Limits of each alone, and of all at their limits, rounded to the safe side"
        table = WholeTable(*frame.rename(columns=heads).columns, title=title)
        for cells in frame.itertuples(index=False):
            table.add_row(*cells)
        yield table
        yield "\n".join(row.sentence for row in self.rows)

    def figure(self) -> Figure:
        """A bar for each characteristic from the original to its limits, with their values."""
        number = len(self.rows)
        title = f"{self.subject}: limits, rounded to the safe side"
        figure, ((axis,),) = new_figure(title, 1, 1, (7.2, 0.9 + 0.55 * number))
        for position, row in enumerate(self.rows):
            row.draw(axis, -position)
        names = [escape_dollars(row.characteristic.short_name) for row in self.rows]
        axis.set_yticks([-position for position in range(number)], names, fontsize=FONT_SIZE)
        axis.set(xlim=(-0.02, 1.02), ylim=(0.5 - number, 0.5), xticks=[])
        axis.set_xlabel(
            "domain from its lower to its upper end; dot: new; line: specified;\n"
            "light: safe alone; dark: safe with all others at theirs",
            fontsize=FONT_SIZE - 1,
        )
        return figure
