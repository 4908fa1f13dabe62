"""The network, as a scenario sees it: straight lanes, coordinates along them, and the world that
moves the actors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, FloatOrArray, Quantity

NETWORK_KEY = "scenario.parameters.network"
MAX_BEND = 0.05
"""Largest deviation of a straight lane's centre line from a straight line [m]."""
Coordinates = tuple[float, float]
MAX_SKEW = 0.05
"""Largest distance along the road between the two ends of a crossing at right angles [m]."""


class Lane(NamedTuple):
    """The first and the last point of a lane's centre line [m]. `flaw` says why the lane is not
    straight; "" for a straight lane.
    """

    start: Coordinates
    end: Coordinates
    flaw: str = ""


def lane_through(name: str, points: Sequence[Coordinates]) -> Lane:
    """Make the lane `name` from the points of its centre line [m]."""
    x, y = points[0]
    lane_dx = points[-1][0] - x
    lane_dy = points[-1][1] - y
    length = math.hypot(lane_dx, lane_dy)
    bend = 0.0
    for point_x, point_y in points:
        dx = point_x - x
        dy = point_y - y
        deviation = math.hypot(dx, dy)
        # A lane that ends at its beginning has no line through both points: the distance counts
        # instead.
        if length:
            deviation = abs(lane_dx * dy - lane_dy * dx) / length
        bend = max(bend, deviation)
    flaw = ""
    if bend > MAX_BEND:
        flaw = f"lane {name!r} deviates {bend:.2f} m from a straight line"
    return Lane(points[0], points[-1], flaw)


class Frame(NamedTuple):
    """Coordinates along and across a straight lane: the origin [m], and the lane's direction as a
    unit vector.
    """

    origin: Coordinates
    direction: Coordinates

    @classmethod
    def of(cls, lane: Lane) -> Frame:
        """The frame of a lane, in the direction from its first point to its last point.

        Raises
        ------
        InputError
            If the lane is not straight.
        """
        if lane.flaw:
            raise InputError(NETWORK_KEY, lane.flaw, "a straight lane")
        x, y = lane.start
        dx = lane.end[0] - x
        dy = lane.end[1] - y
        length = math.sqrt(dx * dx + dy * dy)
        return cls(lane.start, (dx / length, dy / length))

    @classmethod
    def through_origin(cls, lane: Lane) -> Frame:
        """The frame with the lane's direction, and the network's origin. A lane that leads east has
        exactly the network's coordinates.
        """
        return cls((0.0, 0.0), cls.of(lane).direction)

    def along(self, positions: FloatArray) -> FloatArray:
        """The distances of positions along the lane [m], shape (N,). The positions have shape (N,
        2).
        """
        x, y = self.origin
        dir_x, dir_y = self.direction
        return (positions[:, 0] - x) * dir_x + (positions[:, 1] - y) * dir_y

    def left(self, positions: FloatArray) -> FloatArray:
        """The distances of positions to the left of the lane's middle [m], shape (N,). The
        positions have shape (N, 2).
        """
        x, y = self.origin
        dir_x, dir_y = self.direction
        return (positions[:, 1] - y) * dir_x - (positions[:, 0] - x) * dir_y

    def lane_coordinates(self, point: Coordinates) -> Coordinates:
        """The distances of a single point along the lane and to its left [m]."""
        positions = np.array([point])
        return self.along(positions).item(), self.left(positions).item()

    def crossing_position(self, roads: Roads | World, lane: str) -> float:
        """The position along this lane at which another lane crosses it [m].

        Raises
        ------
        InputError
            If the other lane does not cross this lane at right angles.
        """
        crossing = roads.lane(lane)
        start = self.lane_coordinates(crossing.start)[0]
        end = self.lane_coordinates(crossing.end)[0]
        if abs(end - start) > MAX_SKEW:
            raise InputError(
                NETWORK_KEY,
                f"lane {lane!r} leads {abs(end - start):.2f} m along the road",
                "a crossing at right angles",
            )
        return start

    def point(self, along: Quantity, sideways: Quantity) -> Coordinates:
        """The point at these distances along the lane and to its left [m], or several points."""
        x, y = self.origin
        dir_x, dir_y = self.direction
        point_x = x + along * dir_x - sideways * dir_y
        point_y = y + along * dir_y + sideways * dir_x
        return point_x, point_y


class Roads(Protocol):
    """A network without traffic, as a scenario sees it before a run."""

    def lane(self, lane: str) -> Lane:
        """The lane with this id."""


class World(Protocol):
    """N copies of a simulated network, as a scenario sees them during a run."""

    def vehicle_positions(self, actor: str) -> FloatArray:
        """Positions of the front bumper of a vehicle in the N copies [m], shape (N, 2)."""

    def person_positions(self, actor: str) -> FloatArray:
        """Positions of a person in the N copies [m], shape (N, 2)."""

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test [m/s], shape (N,)."""

    def vehicle_length(self, actor: str) -> float:
        """Length of a vehicle [m]."""

    def lane(self, lane: str) -> Lane:
        """The lane with this id, which is the same in all copies. Take its `start` and `end` by
        name: a lane has a third field.
        """

    def lane_of(self, vehicle: str) -> Lane:
        """The lane on which a vehicle is, the same in all copies."""

    def person_width(self, actor: str) -> float:
        """Width of a person [m]."""

    def walk(self, person: str, speed: FloatOrArray) -> None:
        """Make a person continue at a walking speed [m/s], a number for all copies or an array."""

    def turn_back(self, person: str, copies: Sequence[int] | None = None) -> None:
        """Make a person turn round, and walk back to its first edge at the same speed. By default
        the person turns in all copies.
        """
