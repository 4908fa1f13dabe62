"""OpenDRIVE: lines in the plane, and roads with lanes along them. A place in the plane is a complex
number: x + iy.
"""

from __future__ import annotations

import cmath
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.openscenario.document import (
    Element,
    attribute,
    number,
    part,
    root_of,
    unsupported,
)

LEAST_TURN = 1e-9
"""Turn of a curve by its change of curvature below which it is an arc, or a line [rad]."""
STRAIGHT = 1e-6
"""Largest turn of a straight line [rad]."""
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

    def _piece_at(self, distance: Number) -> Number:
        return np.clip(
            np.searchsorted(self.starts, distance, side="right") - 1, 0, len(self.pieces) - 1
        )


Cubics = list[tuple[float, tuple[float, ...]]]
"""Polynomials of third degree, each with the s at which it begins [m]."""


@dataclass(frozen=True)
class Road:
    """A road: its reference line, sections with widths by lane, offsets of lane 0, and the elements
    at its ends; a `flaw` says why nobody can be on it.
    """

    id: str
    pieces: Sequence[Piece]
    flaw: str
    sections: list[tuple[float, dict[int, Cubics]]]
    offsets: Cubics
    links: dict[str, tuple[str, str, str]]
    is_left_hand: bool

    @cached_property
    def line(self) -> Line:
        """The reference line."""
        if self.flaw:
            raise unsupported(self.flaw)
        return Line(self.pieces)

    @property
    def length(self) -> float:
        """Length [m]."""
        return self.line.length

    def lane_t(self, lane: int, s: float) -> float:
        """The t of a lane's middle [m]; that of lane 0 is its offset."""
        start, lanes = self._section(s)
        if lane and lane not in lanes:
            raise unsupported(f"road {self.id} has no lane {lane} at s = {s:.1f} m")
        sign = 1 if lane > 0 else -1
        widths = [_cubic(lanes[sign * k], s - start) for k in range(1, abs(lane) + 1)]
        return _cubic(self.offsets, s) + sign * (sum(widths) - (widths[-1] / 2 if widths else 0.0))

    def lane_at(self, s: float, t: float) -> int:
        """The lane whose middle is nearest."""
        return min(self._section(s)[1], key=lambda lane: abs(self.lane_t(lane, s) - t))

    def _section(self, s: float) -> tuple[float, dict[int, Cubics]]:
        return next(
            (one for one in reversed(self.sections) if one[0] <= s + 1e-9), self.sections[0]
        )


def _cubic(pieces: Cubics, s: float) -> float:
    start, (a, b, c, d) = next((one for one in reversed(pieces) if one[0] <= s + 1e-9), pieces[0])
    ds = max(s - start, 0.0)
    return a + ds * (b + ds * (c + ds * d))


@dataclass(frozen=True)
class Network:
    """The roads of a file, and connections of its junctions: incoming road, connecting road, its
    contact point.
    """

    name: str
    roads: dict[str, Road]
    junctions: dict[str, list[tuple[str, str, str]]]

    def road(self, name: str) -> Road:
        """The road of this id."""
        if name not in self.roads:
            raise unsupported(f"{self.name} has no road {name}")
        return self.roads[name]

    def ways(self, road: str, is_forward: bool) -> list[tuple[str, bool]]:
        """Roads that can follow one that is driven in a direction, each with its own direction."""
        link = self.road(road).links.get("successor" if is_forward else "predecessor")
        if link is None:
            return []
        kind, other, contact = link
        if kind == "road":
            return [(other, contact == "start")]
        return [
            (to, at == "start")
            for incoming, to, at in self.junctions.get(other, [])
            if incoming == road
        ]


def read_network(file: str) -> Network:
    """Read an OpenDRIVE file."""
    return _network(file, os.stat(file).st_mtime_ns)


@lru_cache(maxsize=16)
def _network(file: str, modified: int) -> Network:
    root = root_of(file)
    if root.tag != "OpenDRIVE":
        raise unsupported(f"{file!r} is no OpenDRIVE file")
    roads = {attribute(element, "id"): _road(element) for element in root.findall("road")}
    junctions = {
        attribute(junction, "id"): [
            (
                attribute(one, "incomingRoad"),
                attribute(one, "connectingRoad"),
                attribute(one, "contactPoint"),
            )
            for one in junction.findall("connection")
            if "connectingRoad" in one.attrib
        ]
        for junction in root.findall("junction")
    }
    return Network(os.path.basename(file), roads, junctions)


def _road(element: Element) -> Road:
    """A road of OpenDRIVE."""
    name = attribute(element, "id")
    links = {
        link.tag: (
            attribute(link, "elementType"),
            attribute(link, "elementId"),
            link.get("contactPoint", ""),
        )
        for link in element.findall("link/*")
        if link.tag in ("predecessor", "successor")
    }
    sections = [
        (
            number(section, "s"),
            {
                whole: _cubics(lane, "width", "sOffset")
                for lane in section.iter("lane")
                if (whole := int(attribute(lane, "id")))
            },
        )
        for section in element.findall("lanes/laneSection")
    ]
    offsets = _cubics(part(element, "lanes"), "laneOffset", "s")
    pieces = []
    flaw = ""
    try:
        pieces = [_piece(each, name) for each in element.findall("planView/geometry")]
    except InputError as error:
        flaw = error.problem
    if element.find("lanes//border") is not None:
        flaw = f"the road {name} has lanes with borders; supported: width"
    return Road(name, pieces, flaw, sections, offsets, links, element.get("rule") == "LHT")


def _cubics(element: Element, tag: str, start: str) -> Cubics:
    found = [
        (number(one, start), tuple(number(one, key) for key in "abcd"))
        for one in element.findall(tag)
    ]
    return found or [(0.0, (0.0,) * 4)]


def _piece(geometry: Element, road: str) -> Piece:
    """A geometry of OpenDRIVE: line, arc, spiral."""
    start = Pose.at(number(geometry, "x"), number(geometry, "y"), number(geometry, "hdg"))
    length = number(geometry, "length")
    for shape in geometry:
        match shape.tag:
            case "line":
                return Piece(start, length)
            case "arc":
                return Piece(start, length, number(shape, "curvature"), number(shape, "curvature"))
            case "spiral":
                return Piece(start, length, number(shape, "curvStart"), number(shape, "curvEnd"))
            case "userData" | "include" | "dataQuality":
                continue
        raise unsupported(f"the road {road} has a {shape.tag}; supported: line, arc, spiral")
    raise unsupported(f"the road {road} has a geometry without shape")
