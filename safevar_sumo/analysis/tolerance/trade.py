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
    """How far one characteristic, `second`, may go at values of another one, `first`.

    Attributes
    ----------
    first, second
        The two characteristics.
    fixed
        The limits of other characteristics. These are at their limits and, in a second computation, as in the original;
        the smaller interval counts. All further characteristics are as in the original.
    curve
        By value of the first, the interval around the original in which the second is safe; None if there is none.
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
                texts = [
                    safe_text(second, end, upwards=upwards) + ("*" if end in (second.lower, second.upper) else "")
                    for end, upwards in zip(ends, (True, False), strict=True)
                ]
            table.add_row(safe_text(first, value, upwards=value < first.original), *texts)
        return table

    def figure(self, subject: str) -> Figure:
        """The safe values of the second characteristic over those of the first."""
        first, second = self.first, self.second
        figure, ((axis,),) = new_figure(f"{subject}: {second.name} at values of {first.name}", 1, 1, (4.6, 3.4))
        safe = {value: ends for value, ends in self.curve.items() if ends is not None}
        values, (lows, highs) = list(safe), np.array(list(safe.values())).reshape(-1, 2).T
        axis.vlines(values, lows, highs, color=BLUE, linewidth=5, alpha=0.5)
        axis.plot(values, lows, "_", values, highs, "_", color=BLUE, clip_on=False)
        axis.plot(first.original, second.original, "o", color="black", markersize=5, clip_on=False)
        x_label, y_label = (f"{escape_dollars(item.name)} [{as_formula(item.unit)}]" for item in (first, second))
        axis.set(xlim=(first.lower, first.upper), ylim=(second.lower, second.upper), xlabel=x_label, ylabel=y_label)
        figure.supxlabel("dot: the original vehicle; bars: safe", fontsize=FONT_SIZE)
        return figure


def find_trade(evaluator: Evaluator, names: Sequence[str], unsafe: Unsafe, limits: Mapping[str, Limit]) -> Trade:
    """Find how far the second of two characteristics may go at values of the first.

    The first goes from its original to where it is unsafe by itself.
    """
    characteristics = evaluator.characteristics
    first, second = (characteristics.names.index(name) for name in names)
    fixed = {name: limit for name, limit in limits.items() if name not in names}
    bounds = ([limit.at_least, limit.at_most] for limit in fixed.values())
    corners = list(product(*([end for end in ends if end is not None] for ends in bounds)))
    others = np.tile(characteristics.original, (1 + len(corners), 1))  # the original, and the corners of the limits
    others[1:, [characteristics.names.index(name) for name in fixed]] = corners

    def safe_intervals(column: int, settings: FloatArray) -> list[Interval | None]:
        """Where a characteristic is safe with all of a group of `len(others)` settings, for each group."""
        scans = scan(evaluator, [column] * len(settings), unsafe, settings)
        ends = np.array([each.safe or (np.nan, np.nan) for each in scans]).reshape(-1, len(others), 2)
        lows, highs = ends[..., 0].max(axis=1).tolist(), ends[..., 1].min(axis=1).tolist()  # NaN if one is NaN
        return [None if np.isnan(low) else (low, high) for low, high in zip(lows, highs, strict=True)]

    (ends,) = safe_intervals(first, others)
    values = [] if ends is None else np.union1d(np.linspace(*ends, TRADE_VALUES), others[0, first]).tolist()
    settings = np.tile(others, (len(values), 1))
    settings[:, first] = np.repeat(values, len(others))
    curve = dict(zip(values, safe_intervals(second, settings) if values else [], strict=True))
    members = characteristics.members
    return Trade(first=members[first], second=members[second], fixed=fixed, curve=curve)
