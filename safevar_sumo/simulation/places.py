"""Where a traffic file puts people: places that are on the road, and a road under the vehicle under test that is as it drives on it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import VUT

LEVEL = 0.005
"""So much may a road climb that counts as level, a part of its length."""

Lanes = dict[str, list[ElementTree.Element]]
"""By edge."""


def check_places(root: ElementTree.Element, file: Path, roads: ElementTree.Element) -> None:
    """Refuse places beyond the end of a lane, and a way of the vehicle under test that climbs or is slippery.

    Raises
    ------
    InputError
        Naming the file, the element and its attribute, or the lane.
    """
    lanes = {edge.get("id", ""): list(edge.iter("lane")) for edge in roads.iter("edge")}
    routes = {route.get("id", ""): route for route in root.findall("route")}
    for actor in root:
        way = _way(actor, routes)
        if way:
            _check_on(actor, ("departPos",), way[0], lanes, file)
        if actor.get("id") == VUT and actor.tag in ("vehicle", "trip"):
            for edge in way:
                _check_surface(lanes[edge], file)
    for stop in root.iter("stop"):
        _check_on(stop, ("startPos", "endPos"), stop.get("edge") or stop.get("lane", "").rpartition("_")[0], lanes, file)


def way_of_vut(root: ElementTree.Element) -> list[str]:
    """The edges on which the vehicle under test drives, as far as the traffic file says so."""
    routes = {route.get("id", ""): route for route in root.findall("route")}
    return [edge for actor in root if actor.get("id") == VUT and actor.tag in ("vehicle", "trip") for edge in _way(actor, routes)]


def _way(actor: ElementTree.Element, routes: dict[str, ElementTree.Element]) -> list[str]:
    """The edges on which an actor sets off and, as far as the file says so, goes on."""
    for part in (actor.find("route"), routes.get(actor.get("route", "")), actor, actor.find("walk"), actor.find("personTrip")):
        if part is not None:
            found = " ".join(part.get(name, "") for name in ("edges", "from", "via", "to")).split()
            if found:
                return found
    return []


def _check_on(element: ElementTree.Element, names: tuple[str, ...], edge: str, lanes: Lanes, file: Path) -> None:
    length = max((float(lane.get("length", 0)) for lane in lanes.get(edge, [])), default=float("inf"))
    for name in names:
        value = element.get(name, "0")
        if is_number(value) and not abs(float(value)) <= length:
            called = f"{element.tag} {element.get('id')!r}" if "id" in element.attrib else element.tag
            raise InputError(file, f"{called}: {name} = {value} is not on {edge!r}", f"at most its length, {length:g} m")


def _check_surface(lanes: list[ElementTree.Element], file: Path) -> None:
    for lane in lanes:
        heights = [float((*point.split(","), "0")[2]) for point in lane.get("shape", "").split()]
        climb = max(heights, default=0.0) - min(heights, default=0.0)
        if climb > LEVEL * float(lane.get("length", 0)):
            raise InputError(file, f"vehicle {VUT!r} is to drive on lane {lane.get('id')!r}, which climbs {climb:.2f} m",
                             "a level road, and a scenario's grade; netconvert's option flatten makes one")
        if float(lane.get("friction", 1)) != 1:
            raise InputError(file, f"vehicle {VUT!r} is to drive on lane {lane.get('id')!r} of friction {lane.get('friction')}",
                             "1, and road_friction of the study's [weather]")


def is_number(text: str) -> bool:
    """Whether an attribute is a number, not a word or a distribution."""
    try:
        float(text)
    except ValueError:
        return False
    return True
