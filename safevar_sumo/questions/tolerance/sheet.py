"""The limits sheet: what a workshop needs to know of each characteristic, in its unit and rounded to the safe side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator, Interval
from safevar_sumo.questions.figures import BLUE, FONT_SIZE, VERMILION, as_formula, escape_dollars, new_figure
from safevar_sumo.questions.tables import Column, latex_table, tabulate
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.records import KMH_PER_MS, FloatArray, JsonObject
from safevar_sumo.scenarios import Point, Scenario
from safevar_sumo.study import Limit
from safevar_sumo.terminal import WholeTable
from safevar_sumo.vehicles import Characteristic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NONE, NO_BOX = "-", "no safe box"


def describe_failures(
    evaluator: Evaluator, settings: Mapping[str, FloatArray], points: Sequence[Point], unsafe: Unsafe
) -> dict[str, str]:
    """How unsafe settings fail at their worst points, in words, by the same names."""
    if not settings:
        return {}
    runs = evaluator.evaluate(np.array(list(settings.values())), "what fails first")
    worst = np.zeros(len(runs), dtype=int) if runs.worst_points is None else runs.worst_points
    return {
        name: _failure_in_words(points[point].scenario, unsafe, bool(collided), degree)
        for name, point, collided, degree in zip(settings, worst.tolist(), runs.collided, runs.f_safe, strict=True)
    }


def _failure_in_words(scenario: Scenario, unsafe: Unsafe, collided: bool, degree: float) -> str:
    """A failure at a safety degree, such as `the car hits a pedestrian at 40 km/h`."""
    if unsafe.points is not None:  # points are of the whole matrix
        return f"the car {unsafe.in_words}"
    speed = "" if scenario.test_speed is None else f" at {KMH_PER_MS * scenario.test_speed:.3g} km/h"
    if collided:
        impact_speed = -KMH_PER_MS * degree  # nearly 0 at the limit itself: then it says nothing
        impact = "" if speed or impact_speed < 1 else f" with {impact_speed:.2g} km/h"
        return f"the car hits {scenario.obstacle()}{speed or impact}"
    centre = " from centre to centre" if scenario.centre_to_centre and unsafe.below else ""
    return f"the car keeps less than {unsafe.below or unsafe.keep:.3g} m{centre} from {scenario.obstacle()}{speed}"


@dataclass(frozen=True, kw_only=True)
class LimitRow:
    """How far one characteristic may go.

    Attributes
    ----------
    scan
        How far it may go alone.
    together
        How far it may go together with all others; None if no box is safe, or none was sought.
    is_sought
        Whether a safe box was sought; not in a rated study.
    specified
        The user's limit; None without one.
    beyond, beyond_alone
        What fails first beyond the limit, with the others at their limits, and with the others as in the original; ""
        if nothing is known to fail.
    """

    scan: OneAtATimeScan
    together: Interval | None
    is_sought: bool
    specified: Limit | None
    beyond: str
    beyond_alone: str

    @property
    def characteristic(self) -> Characteristic:
        return self.scan.characteristic

    @property
    def specified_ends(self) -> tuple[float | None, float | None]:
        """The ends of the user's limit; None where there is none."""
        return (None, None) if self.specified is None else (self.specified.at_least, self.specified.at_most)

    @property
    def alone(self) -> Interval | None:
        """The limits alone, rounded inwards; None if nothing is safe."""
        if self.scan.safe is None:
            return None
        item, (low, high) = self.characteristic, self.scan.safe
        return (
            low if low <= item.lower else item.rounded(low, upwards=True),
            high if high >= item.upper else item.rounded(high, upwards=False),
        )

    @property
    def outside(self) -> float | None:
        """How far the specified limit is outside the limit alone [unit]; None if nothing is safe."""
        if self.scan.safe is None:
            return None
        (low, high), (at_least, at_most) = self.scan.safe, self.specified_ends
        below = 0.0 if at_least is None else low - at_least
        above = 0.0 if at_most is None else at_most - high
        return max(below, above, 0.0)

    @property
    def kept(self) -> bool:
        """Whether the car is safe within the specified limit, alone and together."""
        return self.specified is None or (self.outside == 0 and (self.together is not None or not self.is_sought))

    @property
    def fails_first(self) -> str | None:
        """What fails first beyond the limit, else beyond the limit alone."""
        return self.beyond or self.beyond_alone or None

    def to_dict(self) -> JsonObject:
        """A row of `limits` in the JSON."""
        item, nowhere = self.characteristic, (None, None)
        (alone_low, alone_high), (low, high) = self.alone or nowhere, self.together or nowhere
        return {
            "characteristic": item.name,
            "unit": item.unit,
            "original": item.original,
            "together_low": low,
            "together_high": high,
            "alone_low": alone_low,
            "alone_high": alone_high,
            "specified_low": self.specified_ends[0],
            "specified_high": self.specified_ends[1],
            "kept": self.kept,
            "fails_first": self.fails_first,
            "sentence": self.sentence or None,
        }

    def texts(self, ends: Interval) -> tuple[str, str]:
        """The ends of an interval as text; "" where the domain ends.

        The original, and what the user specified, have their own digits.
        """
        item, (low, high) = self.characteristic, ends
        own = (item.original, *self.specified_ends)
        lower, upper = (f"{end:g}" if end in own else item.text(end) for end in ends)
        return ("" if low <= item.lower else lower, "" if high >= item.upper else upper)

    def in_words(self, ends: Interval | None, otherwise: str) -> str:
        """An interval in words: `from 2.32 mm`, `1 to 2 s`, `whole domain`; `otherwise` without one."""
        if ends is None:
            return otherwise
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
        """Whether the specified limit is kept, in words."""
        if self.specified is None:
            return NONE
        if self.outside:
            return f"outside by {self.outside:.3g}{self.characteristic.suffix}"
        return "kept" if self.kept else "outside" if self.outside is None else "kept alone, not together"

    @property
    def sentence(self) -> str:
        """A sentence for a maintenance manual: all of these may be obeyed together; "" if no box was sought."""
        if not self.is_sought:
            return ""
        item = self.characteristic
        name = item.short_name[:1].upper() + item.short_name[1:]
        if self.together is None:
            return f"{name}: {NO_BOX}."
        words = zip(("at least", "at most"), self.texts(self.together), strict=True)
        keep = " and ".join(f"{word} {text}{item.suffix}" for word, text in words if text)
        if not keep:
            return f"{name}: anything from {item.lower:g} to {item.upper:g}{item.suffix}."
        failure = f"; beyond, with the other characteristics at their limits, {self.beyond}" if self.beyond else ""
        return f"{name}: keep {keep}{failure}."

    def draw(self, axis: Axes, height: float) -> None:
        """Draw a bar for the limits alone and one for those together, with values at their ends; 0 to 1 is the
        domain.
        """
        item = self.characteristic
        domain = (item.lower, item.upper)
        axis.plot([0, 1], [height] * 2, color="0.8", linewidth=1, zorder=1)
        for ends, offset, width, alpha in ((self.alone, 0.2, 11, 0.35), (self.together, -0.36, 5, 1.0)):
            if ends is None:
                continue
            places = np.interp(ends, domain, (0, 1))
            axis.plot(places, [height] * 2, color=BLUE, linewidth=width, alpha=alpha, solid_capstyle="butt", zorder=2)
            for text, place, side in zip(self.texts(ends), places, ("left", "right"), strict=True):
                if text and (offset > 0 or ends != self.alone):  # the same values are not written twice
                    label = f"{text}{as_formula(item.suffix)}"
                    axis.text(place, height + offset, label, ha=side, fontsize=FONT_SIZE - 1.5)
        for value in self.specified_ends:
            place = np.interp(math.nan if value is None else value, domain, (0, 1))
            axis.plot([place] * 2, [height - 0.3, height + 0.3], color=VERMILION, linewidth=1.5, zorder=3)
        axis.plot(np.interp(item.original, domain, (0, 1)), height, marker="o", color="black", markersize=4, zorder=4)


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
                    "all together": row.in_words(row.together, NO_BOX if row.is_sought else NONE),
                    "alone": row.in_words(row.alone, "nowhere safe"),
                    "specified": row.specified_in_words,
                    "kept": row.verdict,
                    "fails first": row.fails_first or NONE,
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
            rows = [[*frame.columns], [":---"] * len(frame.columns), *frame.to_numpy().tolist()]
            return "".join(f"| {' | '.join(row)} |\n" for row in rows)
        columns = {str(name): Column("", "") for name in frame.columns}
        return latex_table("limits", tabulate(f"Limits: {self.subject}", columns, frame))

    def parts(self) -> Iterator[WholeTable | str]:
        """The sheet as a table for the terminal, without columns that have no entry, and a sentence for each
        characteristic.
        """
        frame = self.to_frame().drop(columns=["part", "fails first"])
        frame = frame[[name for name in frame if (frame[name] != NONE).any()]]
        title = "Limits to obey all together; alone, with all others as new. Rounded to the safe side"
        table = WholeTable(*frame.columns, title=title)
        for cells in frame.itertuples(index=False):
            table.add_row(*cells)
        yield table
        if sentences := "\n".join(row.sentence for row in self.rows if row.sentence):
            yield sentences

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
            "light: safe alone; dark: safe all together",
            fontsize=FONT_SIZE - 1,
        )
        return figure
