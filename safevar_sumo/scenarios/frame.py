"""Coordinates along the vehicle's lane and to its left, for a lane in any direction."""

from __future__ import annotations

import math
from typing import NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.base import BentLane, Coordinates, Lane

MAX_SKEW = 0.05
"""Largest offset along the road between the two ends of a crossing at right angles [m]."""


class Frame(NamedTuple):
    """Origin [m] and direction, a unit vector, of a straight lane."""

    origin: Coordinates
    direction: Coordinates

    @classmethod
    def of(cls, lane: Lane) -> Frame:
        """The frame of a lane, from its first point to its last.

        Raises
        ------
        InputError
            If the lane is not straight.
        """
        (x, y), (to_x, to_y) = lane.start, lane.end
        if isinstance(lane, BentLane):
            raise InputError(
                "scenario.parameters.network",
                f"lane {lane.name!r} deviates {lane.bend:.2f} m from a straight line",
                "a straight lane",
            )
        length = math.sqrt((to_x - x) * (to_x - x) + (to_y - y) * (to_y - y))
        return cls(lane.start, ((to_x - x) / length, (to_y - y) / length))

    @classmethod
    def through_origin(cls, lane: Lane) -> Frame:
        """The network's coordinates rotated into the direction of a lane; exactly unchanged for a lane that leads
        east.
        """
        return cls((0.0, 0.0), cls.of(lane).direction)

    def along(self, positions: FloatArray) -> FloatArray:
        """Distances of positions, shape (N, 2), along the lane [m]; shape (N,)."""
        (x, y), (dir_x, dir_y) = self.origin, self.direction
        return (positions[:, 0] - x) * dir_x + (positions[:, 1] - y) * dir_y

    def left(self, positions: FloatArray) -> FloatArray:
        """Distances of positions, shape (N, 2), to the left of the lane's middle [m]; shape (N,)."""
        (x, y), (dir_x, dir_y) = self.origin, self.direction
        return (positions[:, 1] - y) * dir_x - (positions[:, 0] - x) * dir_y

    def lane_coordinates(self, point: Coordinates) -> tuple[float, float]:
        """Distances of one point along the lane and to its left [m]."""
        (x, y), (dir_x, dir_y) = self.origin, self.direction
        delta_x, delta_y = point[0] - x, point[1] - y
        return delta_x * dir_x + delta_y * dir_y, delta_y * dir_x - delta_x * dir_y

    def point(self, along: float, left: float) -> Coordinates:
        """The point at these distances along the lane and to its left [m]."""
        (x, y), (dir_x, dir_y) = self.origin, self.direction
        return x + along * dir_x - left * dir_y, y + along * dir_y + left * dir_x
