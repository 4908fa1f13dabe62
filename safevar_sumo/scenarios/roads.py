"""What a scenario knows of its network: straight lanes, coordinates along them, and the world that
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
"""Largest deviation of a lane's centre line from a straight line for which the lane counts as
straight [m].
"""
Coordinates = tuple[float, float]
MAX_SKEW = 0.05
"""Largest offset along the road between the two ends of a crossing at which it still counts as at
right angles [m].
"""


class Lane(NamedTuple):
    """First and last point of a lane's centre line [m]; `flaw` says why the lane is not straight,
    "" if it is.
    """

    start: Coordinates
    end: Coordinates
    flaw: str = ""


def lane_through(name: str, points: Sequence[Coordinates]) -> Lane:
    """The lane `name`, whose centre line goes through these points [m]."""
    x, y = points[0]
    to_x, to_y = points[-1]
    length = math.hypot(to_x - x, to_y - y)
    bend = 0.0
    for at_x, at_y in points:
        deviation = math.hypot(at_x - x, at_y - y)
        # A lane that ends where it begins has no line through both.
        if length:
            deviation = abs((to_x - x) * (at_y - y) - (to_y - y) * (at_x - x)) / length
        bend = max(bend, deviation)
    flaw = ""
    if bend > MAX_BEND:
        flaw = f"lane {name!r} deviates {bend:.2f} m from a straight line"
    return Lane(points[0], points[-1], flaw)


class Frame(NamedTuple):
    """The coordinates of a straight lane: their origin [m], and the lane's direction, a unit
    vector.
    """

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
        if lane.flaw:
            raise InputError(NETWORK_KEY, lane.flaw, "a straight lane")
        x, y = lane.start
        to_x, to_y = lane.end
        length = math.sqrt((to_x - x) * (to_x - x) + (to_y - y) * (to_y - y))
        return cls(lane.start, ((to_x - x) / length, (to_y - y) / length))

    @classmethod
    def through_origin(cls, lane: Lane) -> Frame:
        """A frame with the lane's direction and the network's origin: a lane that leads east has
        exactly the network's coordinates.
        """
        return cls((0.0, 0.0), cls.of(lane).direction)

    def along(self, positions: FloatArray) -> FloatArray:
        """Distances of positions, shape (N, 2), along the lane [m]; shape (N,)."""
        x, y = self.origin
        dir_x, dir_y = self.direction
        return (positions[:, 0] - x) * dir_x + (positions[:, 1] - y) * dir_y

    def left(self, positions: FloatArray) -> FloatArray:
        """Distances of positions, shape (N, 2), to the left of the lane's middle [m]; shape
        (N,).
        """
        x, y = self.origin
        dir_x, dir_y = self.direction
        return (positions[:, 1] - y) * dir_x - (positions[:, 0] - x) * dir_y

    def lane_coordinates(self, point: Coordinates) -> Coordinates:
        """Distances of one point along the lane and to its left [m]."""
        positions = np.array([point])
        return self.along(positions).item(), self.left(positions).item()

    def crossing_position(self, roads: Roads | World, lane: str) -> float:
        """Position along this lane of another lane, which crosses it [m].

        Raises
        ------
        InputError
            If the other lane does not cross it at right angles.
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
        """The point, or the points, at these distances along the lane and to its left [m]."""
        x, y = self.origin
        dir_x, dir_y = self.direction
        return (
            x + along * dir_x - sideways * dir_y,
            y + along * dir_y + sideways * dir_x,
        )


class Roads(Protocol):
    """A network without traffic."""

    def lane(self, lane: str) -> Lane:
        """A lane by its id."""


class World(Protocol):
    """N copies of a simulated network, for scenarios."""

    def vehicle_positions(self, actor: str) -> FloatArray:
        """Front bumpers of a vehicle in its N copies; shape (N, 2) [m]."""

    def person_positions(self, actor: str) -> FloatArray:
        """Positions of a person in its N copies; shape (N, 2) [m]."""

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test; shape (N,) [m/s]."""

    def vehicle_length(self, actor: str) -> float:
        """Length of a vehicle [m]."""

    def lane(self, lane: str) -> Lane:
        """A lane by its id, the same in all copies; take its `start` and `end` by name, as it has a
        third field.
        """

    def lane_of(self, vehicle: str) -> Lane:
        """The lane that a vehicle is on, the same in all copies."""

    def person_width(self, actor: str) -> float:
        """Width of a person [m]."""

    def walk(self, person: str, speed: FloatOrArray) -> None:
        """Make a person continue at a walking speed [m/s], one for all copies or one for each."""

    def turn_back(self, person: str, copies: Sequence[int] | None = None) -> None:
        """Make a person turn round and walk back to its first edge at an unchanged speed, by
        default in all copies.
        """
