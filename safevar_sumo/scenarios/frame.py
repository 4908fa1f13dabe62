"""Places seen from the vehicle's lane: how far along it, and how far to its left; whatever way the lane lies."""

from __future__ import annotations

import math
from typing import NamedTuple

from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.base import Coordinates, Lane


class Frame(NamedTuple):
    """Origin [m] and direction, a unit vector, of a straight lane."""

    origin: Coordinates
    direction: Coordinates

    @classmethod
    def of(cls, lane: Lane) -> Frame:
        """The frame of a lane, from its first point to its last."""
        (x, y), (to_x, to_y) = lane.start, lane.end
        length = math.sqrt((to_x - x) * (to_x - x) + (to_y - y) * (to_y - y))
        return cls(lane.start, ((to_x - x) / length, (to_y - y) / length))

    def along(self, positions: FloatArray) -> FloatArray:
        """Distance along the lane [m], shape (N,), of positions of shape (N, 2)."""
        (x, y), (forth_x, forth_y) = self.origin, self.direction
        return (positions[:, 0] - x) * forth_x + (positions[:, 1] - y) * forth_y

    def left(self, positions: FloatArray) -> FloatArray:
        """Distance to the left of the lane's middle [m], shape (N,), of positions of shape (N, 2)."""
        (x, y), (forth_x, forth_y) = self.origin, self.direction
        return (positions[:, 1] - y) * forth_x - (positions[:, 0] - x) * forth_y

    def place_of(self, point: Coordinates) -> tuple[float, float]:
        """Distances of one point along the lane and to its left [m]."""
        (x, y), (forth_x, forth_y) = self.origin, self.direction
        right, up = point[0] - x, point[1] - y
        return right * forth_x + up * forth_y, up * forth_x - right * forth_y
