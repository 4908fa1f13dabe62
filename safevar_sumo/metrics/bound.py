"""A bound: a limit that a measure must not pass."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import NamedTuple

from safevar_sumo.records import Quantity

COMPARISONS: Mapping[str, Callable[[Quantity, float], Quantity]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


class MetricBound(NamedTuple):
    """A measure, a comparison (a key of `COMPARISONS`), and a limit. A vehicle is unsafe if the
    comparison is true: `drac > 6`.
    """

    measure: str
    comparison: str
    limit: float

    def __str__(self) -> str:
        return f"{self.measure} {self.comparison} {self.limit:.12g}"

    @property
    def worst_is_largest(self) -> bool:
        return self.comparison.startswith(">")

    @property
    def sign(self) -> int:
        """1 if small values are unsafe, -1 if large values are unsafe."""
        return -1 if self.worst_is_largest else 1
