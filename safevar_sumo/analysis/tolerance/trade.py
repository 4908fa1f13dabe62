"""The trade-off of two characteristics: how far one may go where the other has already gone some of its way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator, Interval
from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, as_formula, escape_dollars, new_figure
from safevar_sumo.analysis.tolerance.scans import scan
from safevar_sumo.analysis.tolerance.sheet import safe_text
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.study import Limit
from safevar_sumo.terminal import WholeTable
from safevar_sumo.vehicles import Characteristic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRADE_VALUES = 10
"""Number of values of the first characteristic, besides the original if it lies between them."""


@dataclass(frozen=True, kw_only=True)
class Trade:
    """How far the `second` characteristic may go at values of the `first`.

    `curve` has the safe interval of the second around its original by the value of the first, None where there is none.
    Characteristics of `fixed` are at these limits, and as in the original: the worse of both counts. All others are as
    in the original.
    """

    first: Characteristic
    second: Characteristic
    fixed: Mapping[str, Limit]
    curve: Mapping[float, Interval | None]

    def to_dict(self) -> JsonObject:
        """The entry `trade` of the JSON."""
        return {
            "characteristics": [self.first.name, self.second.name],
            "units": [self.first.unit, self.second.unit],
            "fixed": {name: [limit.at_least, limit.at_most] for name, limit in self.fixed.items()},
            "curve": [{"value": value, "safe": ends} for value, ends in self.curve.items()],
        }

    @property
    def title(self) -> str:
        """What the curve shows, and where all other characteristics are."""
        at_limits = f"{', '.join(self.fixed)} at the specified limits, all " if self.fixed else ""
        others = f"{at_limits}others as in the original{'' if self.curve else ': nowhere safe'}"
        return f"How far {self.second.name} may go at values of {self.first.name}, {others}"

    def table(self) -> WholeTable:
        """The curve as a table for the terminal, limits rounded to the safe side."""
        first, second = self.first, self.second
        heads = (f"{first.name} [{first.unit}]", f"{second.name} [{second.unit}] safe from", "to")
        table = WholeTable(right=heads, title=self.title)
        for value, ends in self.curve.items():
            texts = ["nowhere"] * 2
            if ends is not None:
                stars = ["*" if end in (second.lower, second.upper) else "" for end in ends]
                texts = [safe_text(second, ends[k], upwards=k == 0) + stars[k] for k in (0, 1)]
            table.add_row(safe_text(first, value, upwards=value < first.original), *texts)
        return table

    def figure(self, subject: str) -> Figure:
        """The safe values of the second characteristic over those of the first."""
        first, second = self.first, self.second
        figure, ((axis,),) = new_figure(f"{subject}: {second.name} at values of {first.name}", 1, 1, (4.6, 3.4))
        found = {value: ends for value, ends in self.curve.items() if ends is not None}
        lows, highs = np.array(list(found.values())).reshape(-1, 2).T
        axis.vlines(list(found), lows, highs, color=BLUE, linewidth=5, alpha=0.5)
        axis.plot(list(found), lows, "_", list(found), highs, "_", color=BLUE, clip_on=False)
        axis.plot(first.original, second.original, "o", color="black", markersize=5, clip_on=False)
        labels = [f"{escape_dollars(one.name)} [{as_formula(one.unit)}]" for one in (first, second)]
        axis.set(xlim=(first.lower, first.upper), ylim=(second.lower, second.upper), xlabel=labels[0], ylabel=labels[1])
        figure.supxlabel("dot: the original vehicle; bars: safe", fontsize=FONT_SIZE)
        return figure


def find_trade(evaluator: Evaluator, names: Sequence[str], unsafe: Unsafe, limits: Mapping[str, Limit]) -> Trade:
    """How far the second of two characteristics may go at values of the first: from its original to where it is unsafe
    by itself.
    """
    characteristics = evaluator.characteristics
    first, second = (characteristics.names.index(name) for name in names)
    fixed = {name: limit for name, limit in limits.items() if name not in names}
    corners = list(
        product(*(filter(lambda end: end is not None, (one.at_least, one.at_most)) for one in fixed.values()))
    )
    others = np.tile(characteristics.original, (1 + len(corners), 1))
    others[1:, [characteristics.names.index(name) for name in fixed]] = corners

    def safe_intervals(column: int, settings: FloatArray) -> list[Interval | None]:
        """The interval of a characteristic that is safe with each of the `others`, for K settings of another one."""
        safe = [one.safe for one in scan(evaluator, [column] * len(settings), unsafe, settings)]
        intervals: list[Interval | None] = []
        for start in range(0, len(safe), len(others)):
            found = [ends for ends in safe[start : start + len(others)] if ends is not None]
            lows, highs = zip(*found, strict=True) if len(found) == len(others) else ((), ())
            intervals.append((max(lows), min(highs)) if lows else None)
        return intervals

    (ends,) = safe_intervals(first, others)
    values = [] if ends is None else np.union1d(np.linspace(*ends, TRADE_VALUES), others[0, first]).tolist()
    settings = np.tile(others, (len(values), 1))
    settings[:, first] = np.repeat(values, len(others))
    curve = dict(zip(values, safe_intervals(second, settings) if values else [], strict=True))
    members = characteristics.members
    return Trade(first=members[first], second=members[second], fixed=fixed, curve=curve)
