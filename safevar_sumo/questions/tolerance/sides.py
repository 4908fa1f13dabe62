"""Boxes that are given by their sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

ROUNDING = 1e-9
"""Rounding errors of a setting, as a share of the domain."""
Step = Sequence[int]
"""A side of a box, below or above, and the column of its characteristic."""


class BoxGeometry:
    """Boxes that are given by their sides: the extents below and above the original, shape (2, n),
    in the units of the characteristics.

    Attributes
    ----------
    width
        Widths of the domains; 0 for a characteristic that does not vary.
    domain
        The extents of the domains.
    limits
        The values of the sides that are at limits, NaN for the free ones.
    is_free
        Which sides may move; the others are at their limits.
    longest
        The longest that each side may be: a free one to the end of its domain, or to that of an
        outer box within which it stays, a fixed one to its limit.
    fixed
        The box whose free sides are 0.
    """

    def __init__(
        self, region: FeasibleRegion, columns: Sequence[int], limits: Mapping[str, Limit]
    ) -> None:
        members = region.characteristics
        self.region = region
        self.original = members.original
        is_varied = np.isin(range(len(members)), columns)
        self.domain = (
            np.stack([self.original - members.lower, members.upper - self.original]) * is_varied
        )
        self.width = self.domain.sum(axis=0)
        self.limits = np.full_like(self.domain, np.nan)
        for name, limit in limits.items():
            self.limits[:, members.names.index(name)] = limit.at_least, limit.at_most  # None is NaN
        self.is_free = (self.domain > 0) & np.isnan(self.limits)
        self.longest = np.where(
            np.isnan(self.limits), self.domain, np.abs(self.limits - self.original)
        )
        self.fixed = np.where(self.is_free, 0.0, self.longest)

    def stay_within(self, outer: Box) -> None:
        """Let no free side be longer than that of an outer box of vehicles."""
        shorter = np.minimum(self.longest, self.sides_of(outer))
        self.longest = np.where(self.is_free, shorter, self.longest)

    @property
    def characteristics(self) -> CharacteristicSet:
        return self.region.characteristics

    def box(self, sides: FloatArray) -> Box:
        return Box(self.region, self.original - sides[0], self.original + sides[1])

    def sides_of(self, box: Box) -> FloatArray:
        """The sides of a box."""
        return np.stack([self.original - box.lower, box.upper - self.original])

    def printed(self, sides: FloatArray) -> Box:
        """A box as it is printed: limits and ends of domains exactly, all others rounded
        inwards.
        """
        box = self.box(sides)
        members = self.characteristics
        ends = np.array(
            [
                [
                    item.rounded(end, upwards=upwards)
                    for item, end in zip(members, ends, strict=True)
                ]
                for ends, upwards in ((box.lower, True), (box.upper, False))
            ]
        )
        ends = np.where(sides >= self.domain, np.stack([members.lower, members.upper]), ends)
        ends = np.where(self.domain > 0, ends, self.original)
        lower, upper = np.where(np.isnan(self.limits), ends, self.limits)
        return Box(self.region, lower, upper)

    def extents(self, settings: FloatArray) -> FloatArray:
        """The sides that a box needs to hold each of K settings, shape (K, 2, n); below 0 where it
        needs none.
        """
        change = settings - self.original
        return np.asarray(np.stack([-change, change], axis=1) - ROUNDING * self.width)

    def wider(self, sides: FloatArray, steps: Sequence[Step], share: float) -> FloatArray:
        """A box with some sides moved outwards by a share of the domain, up to their longest."""
        wider = sides.copy()
        for side, column in steps:
            wider[side, column] = min(
                sides[side, column] + share * self.width[column], self.longest[side, column]
            )
        return wider

    def is_no_larger(self, box: Box, other: Box) -> bool:
        """Whether a box is no larger than another one."""
        volumes = self.log_volume(np.stack([self.sides_of(box), self.sides_of(other)]))
        return bool(volumes[0] <= volumes[1])

    def log_volume(self, boxes: FloatArray) -> FloatArray:
        """The logarithm of the volume of boxes, shape (..., 2, n), as a share of the domain's."""
        shares = np.divide(
            boxes.sum(axis=-2), self.width, out=np.ones_like(boxes[..., 0, :]), where=self.width > 0
        )
        return np.asarray(
            np.sum(np.log(np.maximum(shares, 1e-9)), axis=-1)
        )  # finite for a width of 0, too
