"""A network's traffic read as a list of actors, where all of it can be put onto the road again exactly as it was.

What SUMO draws at random, times by the clock or keeps state of outside an actor cannot: flows, speed deviations,
traffic lights, detectors. Whatever is not known here counts as such.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.sumo.network import copied_network
from safevar_sumo.sumo.sources import TRAFFIC

_TYPE = frozenset({
    "id", "vClass", "length", "width", "height", "minGap", "maxSpeed", "accel", "decel", "emergencyDecel", "tau", "mass", "sigma",
    "speedDev", "speedFactor", "color", "guiShape"})
_PLACES = frozenset({"departLane", "departPos", "departSpeed", "arrivalLane", "arrivalPos", "arrivalSpeed"})
_VEHICLE = _PLACES | {"id", "type", "route", "depart", "departPosLat", "insertionChecks", "color"}
_PERSON = frozenset({"id", "type", "depart", "departPos", "color"})
_ROUTE = frozenset({"id", "edges"})
_STOP = frozenset({"lane", "startPos", "endPos", "duration", "parking"})
_WALK = frozenset({"edges", "speed", "arrivalPos"})
_OPTIONS = re.compile(
    r"net-file|route-files|step-length|step-method\.ballistic|(intermodal-)?collision\..*|pedestrian\..*|lateral-resolution|"
    r"time-to-teleport.*|gui-settings-file|delay")
_TIMED_ROADS = re.compile(rb"<tlLogic|type=\"rail_")
"""Traffic lights and rail signals in a built network."""

_TRUTH = {"true": True, "false": False, "1": True, "0": False}
LEAST_STOP = 0.2
"""Length of a stop of which the traffic file gives the end alone [m]; SUMO, `SUMOVehicleParserHelper`, 2 POSITION_EPS."""


CHECKED = "all"
"""SUMO's insertion checks, unless a vehicle asks for others."""


class Stop(NamedTuple):
    """Where a vehicle stands, from `start` to `end` on a lane [m], how long [s], and whether beside the lane."""

    edge: str
    lane: int
    start: float
    end: float
    duration: float
    parking: bool


class Car(NamedTuple):
    """A vehicle of any kind; it departs at once, where and how fast the SUMO attributes in `places` say.

    `left` is how far it stands to the left of its lane's middle [m], `checks` which of SUMO's insertion checks it has to pass.
    """

    name: str
    type: str
    edges: tuple[str, ...]
    places: dict[str, str]
    left: float
    checks: str
    stops: tuple[Stop, ...]


class Walk(NamedTuple):
    """Edges, speed [m/s] and the place on the last edge where it ends [m]."""

    edges: tuple[str, ...]
    speed: float
    end: float


class Walker(NamedTuple):
    """A person that sets off at once at a place on the first walk's first edge [m]."""

    name: str
    type: str
    place: float
    walks: tuple[Walk, ...]


Traffic = tuple[Car | Walker, ...]
"""Everybody in one copy of a network, in the order of the traffic file."""


class _Unknown(Exception):
    """Something that we would not put back exactly."""


def repeatable_traffic(folder: str, options: Sequence[str] = ()) -> Traffic | None:
    """The actors on a network, or nothing where they could not be put back exactly under its and these further options."""
    files = copied_network(folder, 1)
    if _timed(files.network) or not all(_OPTIONS.fullmatch(name.removeprefix("--")) for name in options[::2]):
        return None
    return _read((files.options.parent / TRAFFIC).read_bytes(), files.options.read_bytes())


def common_checks(traffic: Sequence[Traffic]) -> str | None:
    """The insertion checks of all cars, or nothing where they differ: of a car that is added SUMO takes them from an option."""
    checks = {actor.checks for actors in traffic for actor in actors if isinstance(actor, Car)} or {CHECKED}
    return checks.pop() if len(checks) == 1 else None


@cache
def _timed(network: Path) -> bool:
    return _TIMED_ROADS.search(network.read_bytes()) is not None


@cache
def _read(traffic: bytes, options: bytes) -> Traffic | None:
    try:
        given = {one.tag: one.get("value") for one in ElementTree.fromstring(options).iter() if "value" in one.attrib}
        root = ElementTree.fromstring(traffic)
        _demand(all(_OPTIONS.fullmatch(name) for name in given))
        _demand(not root.findall("person") or float(given.get("pedestrian.striping.dawdling") or 1) == 0)
        routes = {route.get("id"): route for route in root.findall("route")}
        return tuple(actor for element in root if (actor := _actor(element, routes)) is not None)
    except (_Unknown, ElementTree.ParseError, ValueError, KeyError, IndexError):
        return None


def _actor(element: ElementTree.Element, routes: dict[str | None, ElementTree.Element]) -> Car | Walker | None:
    match element.tag:
        case "vType":
            _known(element, _TYPE)
            _demand(float(element.attrib["speedDev"]) == 0)
            float(element.get("speedFactor", 1))  # a number, not a distribution
            _demand(element.get("vClass") == "pedestrian" or float(element.attrib["sigma"]) == 0)
        case "route":
            _known(element, _ROUTE)
        case "vehicle":
            return _car(element, routes)
        case "person":
            return _walker(element)
        case _:
            raise _Unknown
    return None


def _car(element: ElementTree.Element, routes: dict[str | None, ElementTree.Element]) -> Car:
    _known(element, _VEHICLE, "route", "stop")
    inside = element.findall("route")
    route = inside[0] if inside else routes[element.attrib["route"]]
    _known(route, _ROUTE)
    places = {name: value for name, value in element.attrib.items() if name in _PLACES}
    checks = element.get("insertionChecks", CHECKED)
    _demand(checks in (CHECKED, "none"))
    _demand(float(element.attrib["depart"]) == 0 and not any(value.startswith("random") for value in places.values()))
    return Car(element.attrib["id"], element.attrib["type"], tuple(route.attrib["edges"].split()), places,
               float(element.get("departPosLat", 0)), checks, tuple(_stop(stop) for stop in element.findall("stop")))


def _stop(element: ElementTree.Element) -> Stop:
    _known(element, _STOP)
    edge, _, lane = element.attrib["lane"].rpartition("_")
    end, parking = float(element.attrib["endPos"]), element.get("parking", "false")
    start = float(element.get("startPos", max(0.0, end - LEAST_STOP)))
    _demand(start >= 0 and parking in _TRUTH)
    return Stop(edge, int(lane), start, end, float(element.attrib["duration"]), _TRUTH[parking])


def _walker(element: ElementTree.Element) -> Walker:
    _known(element, _PERSON, "walk")
    _demand(float(element.attrib["depart"]) == 0)
    return Walker(element.attrib["id"], element.attrib["type"], float(element.attrib["departPos"]),
                  tuple(_walk(walk) for walk in element.findall("walk")))


def _walk(element: ElementTree.Element) -> Walk:
    _known(element, _WALK)
    return Walk(tuple(element.attrib["edges"].split()), float(element.attrib["speed"]), float(element.attrib["arrivalPos"]))


def _known(element: ElementTree.Element, attributes: frozenset[str], *children: str) -> None:
    _demand(set(element.attrib) <= attributes and all(child.tag in children for child in element))


def _demand(holds: bool) -> None:
    if not holds:
        raise _Unknown
