"""OpenDRIVE: roads with lanes along a line."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.openscenario.document import (
    Element,
    attribute,
    number,
    part,
    root_of,
    unsupported,
    whole,
)
from safevar_sumo.openscenario.lines import Line, Piece, Pose
from safevar_sumo.openscenario.polynomials import pieces_of

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
    is_level: bool

    @cached_property
    def line(self) -> Line:
        """The reference line."""
        self.check()
        return Line(self.pieces)

    def check(self) -> None:
        """Refuse a road on which nobody can be."""
        if self.flaw:
            raise unsupported(self.flaw, f"a road of widths, and of {one_of(SHAPES)}")

    @property
    def length(self) -> float:
        """Length [m]."""
        return self.line.length

    def lane_t(self, lane: int, s: float) -> float:
        """The t of a lane's middle [m]; that of lane 0 is its offset."""
        start, lanes = self._section(s)
        if lane and lane not in lanes:
            raise unsupported(
                f"road {self.id} has no lane {lane} at s = {s:.1f} m",
                f"one of {', '.join(map(str, sorted(lanes)))}",
            )
        sign = 1 if lane > 0 else -1
        widths = [_cubic(lanes[sign * k], s - start) for k in range(1, abs(lane) + 1)]
        return _cubic(self.offsets, s) + sign * (sum(widths) - (widths[-1] / 2 if widths else 0.0))

    def lanes_at(self, s: float) -> list[int]:
        """The lanes there are at s."""
        return [*self._section(s)[1]]

    def lane_at(self, s: float, t: float) -> int:
        """The lane whose middle is nearest."""
        return min(self.lanes_at(s), key=lambda lane: abs(self.lane_t(lane, s) - t))

    def has_lane(self, s: float, t: float) -> bool:
        """Whether a lane is there."""
        start, lanes = self._section(s)
        ways = [
            abs(self.lane_t(lane, s) - t) - _cubic(widths, s - start) / 2
            for lane, widths in lanes.items()
        ]
        return min(ways, default=1.0) <= 0

    @cached_property
    def is_even(self) -> bool:
        """Whether no lane changes its place along the road."""
        cubics = [self.offsets, *(one for _, lanes in self.sections for one in lanes.values())]
        return len(self.sections) == 1 and not any(
            len(one) > 1 or any(one[0][1][1:]) for one in cubics
        )

    def _section(self, s: float) -> tuple[float, dict[int, Cubics]]:
        self.check()
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
            raise unsupported(f"{self.name} has no road {name}", one_of(self.roads))
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


LONG, WIDTH = 100_000.0, 3.5
"""Length of the road of a file that names none, and width of its lanes [m]."""
MOST_LANES = 20
"""Lanes on each side of it at most."""


def straight_network(scenario: Element) -> Network:
    """A straight road to the east for a file that names none, with the lanes that it needs."""
    names = {one.get("roadId", "") for one in scenario.iter() if "roadId" in one.attrib}
    if len(names) > 1:
        problem = f"the file names no road file, but the roads {', '.join(sorted(names))}"
        raise unsupported(problem, "RoadNetwork/LogicFile, or places on one road")
    lanes = [
        abs(whole(one, key))
        for one in scenario.iter()
        for key in ("laneId", "dLane", "value")
        if key in one.attrib and (key != "value" or one.tag.endswith("TargetLane"))
    ]
    # Steps from lane to lane lead at most so far.
    most = min(max(sum(lanes), 1), MOST_LANES)
    widths: dict[int, Cubics] = {
        lane: [(0.0, (WIDTH, 0.0, 0.0, 0.0))] for lane in range(-most, most + 1) if lane
    }
    name = "".join(names)
    line = [Piece(Pose.at(0.0, 0.0, 0.0), LONG)]
    offsets: Cubics = [(0.0, (0.0,) * 4)]
    road = Road(name, line, "", [(0.0, widths)], offsets, {}, is_left_hand=False, is_level=True)
    return Network("the road", {name: road}, {})


def read_network(file: str) -> Network:
    """Read an OpenDRIVE file."""
    return _network(file, os.stat(file).st_mtime_ns)


@lru_cache(maxsize=16)
def _network(file: str, modified: int) -> Network:
    root = root_of(file)
    if root.tag != "OpenDRIVE":
        raise unsupported(f"{file!r} is no OpenDRIVE file", "a file whose root is OpenDRIVE")
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
    pieces: list[Piece] = []
    sections: list[tuple[float, dict[int, Cubics]]] = []
    offsets: Cubics = []
    flaw = ""
    try:
        for each in element.findall("planView/geometry"):
            pieces += _pieces(each, name)
        offsets = _cubics(part(element, "lanes"), "laneOffset", "s")
        sections = [_section(each, name) for each in element.findall("lanes/laneSection")]
    except InputError as error:
        flaw = error.problem
    if not flaw and not (pieces and sections):
        flaw = f"the road {name} has no {'laneSection' if pieces else 'geometry'}"
    if element.find("lanes//border") is not None:
        flaw = f"the road {name} has lanes with borders; supported: width"
    heights = [*element.iterfind("elevationProfile/*"), *element.iterfind("lateralProfile/*")]
    is_level = not any(number(one, key, 0.0) for one in heights for key in "bcd")
    is_left_hand = element.get("rule") == "LHT"
    return Road(name, pieces, flaw, sections, offsets, links, is_left_hand, is_level)


def _section(element: Element, road: str) -> tuple[float, dict[int, Cubics]]:
    """A section of lanes: where it begins, and the widths of its lanes."""
    lanes = {whole(lane, "id"): _cubics(lane, "width", "sOffset") for lane in element.iter("lane")}
    lanes.pop(0, None)
    for lane in lanes:
        inner = lane - 1 if lane > 0 else lane + 1
        if inner and inner not in lanes:
            raise unsupported(f"the road {road} has a lane {lane} without {inner}", "all lanes")
    return number(element, "s"), lanes


def _cubics(element: Element, tag: str, start: str) -> Cubics:
    found = [
        (number(one, start), tuple(number(one, key) for key in "abcd"))
        for one in element.findall(tag)
    ]
    return found or [(0.0, (0.0,) * 4)]


SHAPES = ("line", "arc", "spiral", "poly3", "paramPoly3")
"""Shapes of OpenDRIVE's geometries."""


def _pieces(geometry: Element, road: str) -> list[Piece]:
    """A geometry of OpenDRIVE."""
    start = Pose.at(number(geometry, "x"), number(geometry, "y"), number(geometry, "hdg"))
    length = number(geometry, "length")
    for shape in geometry:
        match shape.tag:
            case "line":
                return [Piece(start, length)]
            case "arc":
                return [Piece(start, length, *2 * [number(shape, "curvature")])]
            case "spiral":
                ends = (number(shape, key) for key in ("curvStart", "curvEnd"))
                return [Piece(start, length, *ends)]
            case "poly3" | "paramPoly3":
                return pieces_of(start, length, shape)
            case "userData" | "include" | "dataQuality":
                continue
        raise unsupported(f"the road {road} has a {shape.tag}", one_of(SHAPES))
    raise unsupported(f"the road {road} has a geometry without shape", one_of(SHAPES))
