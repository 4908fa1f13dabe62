"""Lines in the plane, of pieces that are straight or bend evenly. A place in the plane is a complex
number: x + iy.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

LEAST_TURN = 1e-9
"""Turn of a curve by its change of curvature below which it is an arc, or a line [rad]."""
STRAIGHT = 1e-6
"""Largest turn of a straight line [rad]."""
MOST_SAMPLES = 10_000
"""Number of places at which a line is sampled at most."""
Number = Any
"""A number or an array of them, real or complex."""


class Pose(NamedTuple):
    """A place in the plane [m], and the direction that it faces, a number of size 1."""

    place: Number
    facing: Number

    @classmethod
    def at(cls, x: float, y: float, heading: float) -> Pose:
        """The pose at a heading, counterclockwise from east [rad]."""
        return cls(complex(x, y), unit(heading))

    def moved(self, ahead: Number, left: Number = 0.0) -> Pose:
        """The pose that is so far ahead and to the left [m]."""
        return Pose(self.place + (ahead + 1j * left) * self.facing, self.facing)

    def turned(self, by: Number) -> Pose:
        """The pose turned by a direction."""
        return Pose(self.place, self.facing * by)


def unit(heading: float) -> complex:
    """The direction of a heading [rad]; exact for the four along the axes."""
    quarter = heading / (math.pi / 2)
    return (
        (1, 1j, -1, -1j)[round(quarter) % 4]
        if abs(quarter - round(quarter)) < 1e-12
        else cmath.exp(1j * heading)
    )


class Piece(NamedTuple):
    """A piece of a line: its first pose, its length, and its curvatures at both ends, linear in
    between [1/m].
    """

    start: Pose
    length: float
    first: float = 0.0
    last: float = 0.0

    @property
    def slope(self) -> float:
        """Change of the curvature along the piece [1/m^2]."""
        return (self.last - self.first) / self.length if self.length else 0.0

    def pose(self, distance: Number) -> Pose:
        """The pose at a distance from the start."""
        slope = self.slope
        first = self.first
        if abs(slope) * self.length**2 < LEAST_TURN:
            if abs(first) * self.length < LEAST_TURN:
                return self.start.moved(distance)
            turn = np.exp(1j * first * distance)
            return Pose(
                self.start.place + self.start.facing * (turn - 1) / (1j * first),
                self.start.facing * turn,
            )
        # Fresnel's integrals count from where the curvature is 0.
        scale = math.sqrt(abs(slope) / math.pi)
        sign = math.copysign(1.0, slope)
        offset = first / slope
        turn = np.exp(1j * (first * distance + slope * np.square(distance) / 2))
        way = (_fresnel((distance + offset) * scale, sign) - _fresnel(offset * scale, sign)) / scale
        base = self.start.facing * cmath.exp(-0.5j * first * offset)
        return Pose(self.start.place + base * way, self.start.facing * turn)

    def reversed(self) -> Piece:
        """The piece from its end to its start."""
        return Piece(self.pose(self.length).turned(-1), self.length, -self.last, -self.first)


def _fresnel(value: Number, sign: float) -> Number:
    from scipy.special import fresnel  # takes longer to load than a simulation

    sine, cosine = fresnel(value)
    return cosine + 1j * sign * sine


@dataclass(frozen=True)
class Line:
    """A line of pieces, straight on beyond both ends.

    A trajectory has vertices at these `stations` [m], with `times` [s] and directions that a body
    faces, `facings`, if the file states them.
    """

    pieces: Sequence[Piece]
    stations: Sequence[float] = ()
    times: Sequence[float] = ()
    facings: Sequence[complex] = ()

    @cached_property
    def starts(self) -> Number:
        """Distances at which the pieces begin, and that of the end."""
        return np.concatenate([[0.0], np.cumsum([piece.length for piece in self.pieces])])

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.starts[-1])

    @cached_property
    def is_straight(self) -> bool:
        """Whether it turns nowhere."""
        facing = self.pieces[0].start.facing
        return all(
            abs(cmath.phase(piece.start.facing / facing)) < STRAIGHT
            and not piece.first
            and not piece.last
            for piece in self.pieces
        )

    def pose(self, distance: Number, left: Number = 0.0) -> Pose:
        """The poses at distances along the line, and so far to its left."""
        if len(self.pieces) == 1 and self.is_straight and not self.facings:
            return self.pieces[0].start.moved(distance, left)
        distances = np.atleast_1d(np.asarray(distance, dtype=float))
        inside = np.clip(distances, 0.0, self.length)
        place = np.empty(len(inside), complex)
        facing = np.empty(len(inside), complex)
        pieces = self._piece_at(inside)
        for k in np.unique(pieces):
            here = pieces == k
            place[here], facing[here] = self.pieces[k].pose(inside[here] - self.starts[k])
        pose = Pose(place, facing).moved(distances - inside, left)
        if self.facings:
            between = np.interp(inside, self.stations, self.facings)
            pose = pose._replace(facing=between / np.abs(between))
        return pose if np.ndim(distance) else Pose(complex(pose.place[0]), complex(pose.facing[0]))

    def curvature(self, distance: Number) -> Number:
        """The curvatures at distances [1/m]."""
        inside = np.clip(distance, 0.0, self.length)
        firsts, slopes = (
            np.array([getattr(piece, name) for piece in self.pieces]) for name in ("first", "slope")
        )
        k = self._piece_at(inside)
        return firsts[k] + slopes[k] * (inside - self.starts[k])

    @cached_property
    def stray(self) -> float:
        """How far the line leaves the straight line along its first direction [m]."""
        first = self.pose(0.0)
        return float(np.abs(((self.samples - first.place) / first.facing).imag).max())

    @property
    def samples(self) -> Number:
        """Places along the line, one each metre, or `MOST_SAMPLES`."""
        return self.pose(
            np.linspace(0.0, self.length, min(round(self.length) + 2, MOST_SAMPLES))
        ).place

    def along(self, place: Number) -> Number:
        """How far places are along the line's first direction [m]."""
        first = self.pose(0.0)
        return ((place - first.place) / first.facing).real

    def _piece_at(self, distance: Number) -> Number:
        return np.clip(
            np.searchsorted(self.starts, distance, side="right") - 1, 0, len(self.pieces) - 1
        )
