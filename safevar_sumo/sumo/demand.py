"""Checks of a traffic file: positions on the road, a level road for the vehicle under test, and no randomness."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import DEMAND_IDS, parse_seconds

MAX_SLOPE = 0.005
"""Largest difference in height on a road that counts as level, per length [-]."""

Lanes = dict[str, list[ElementTree.Element]]
"""Lanes by edge."""


def check_positions(root: ElementTree.Element, file: Path, roads: ElementTree.Element) -> None:
    """Refuse positions beyond the end of a lane, and a sloping or slippery road of the vehicle under test.

    Raises
    ------
    InputError
        Naming the file, the element and its attribute, or the lane.
    """
    lanes = {edge.get("id", ""): list(edge.iter("lane")) for edge in roads.iter("edge")}
    routes = {route.get("id", ""): route for route in root.findall("route")}
    for actor in root:
        edges = _edges_of(actor, routes)
        if edges:
            _check_position(actor, ("departPos",), edges[0], lanes, file)
        if actor.get("id") == VUT and actor.tag in ("vehicle", "trip"):
            for edge in edges:
                _check_surface(lanes[edge], file)
    for stop in root.iter("stop"):
        _check_position(stop, ("startPos", "endPos"), stop.get("edge") or stop.get("lane", "").rpartition("_")[0], lanes, file)


def edges_of_vut(root: ElementTree.Element) -> list[str]:
    """The edges that the traffic file names for the vehicle under test."""
    routes = {route.get("id", ""): route for route in root.findall("route")}
    return [edge for actor in root if actor.get("id") == VUT and actor.tag in ("vehicle", "trip") for edge in _edges_of(actor, routes)]


def _edges_of(actor: ElementTree.Element, routes: dict[str, ElementTree.Element]) -> list[str]:
    """The edges that the traffic file names for an actor, in driving order."""
    for element in (actor.find("route"), routes.get(actor.get("route", "")), actor, actor.find("walk"), actor.find("personTrip")):
        if element is not None:
            edges = " ".join(element.get(name, "") for name in ("edges", "from", "via", "to")).split()
            if edges:
                return edges
    return []


def _check_position(element: ElementTree.Element, names: tuple[str, ...], edge: str, lanes: Lanes, file: Path) -> None:
    length = max((float(lane.get("length", 0)) for lane in lanes.get(edge, [])), default=float("inf"))
    for name in names:
        value = element.get(name, "0")
        if is_number(value) and not abs(float(value)) <= length:
            raise InputError(file, f"{_label(element)}: {name} = {value} is not on {edge!r}", f"at most its length, {length:g} m")


def _check_surface(lanes: list[ElementTree.Element], file: Path) -> None:
    for lane in lanes:
        heights = [float((*point.split(","), "0")[2]) for point in lane.get("shape", "").split()]
        climb = max(heights, default=0.0) - min(heights, default=0.0)
        if climb > MAX_SLOPE * float(lane.get("length", 0)):
            raise InputError(file, f"vehicle {VUT!r} drives on lane {lane.get('id')!r}, which rises {climb:.2f} m",
                             "a level road, as netconvert's option `flatten` makes it; the scenario's `grade` sets a slope")
        if float(lane.get("friction", 1)) != 1:
            raise InputError(file, f"vehicle {VUT!r} drives on lane {lane.get('id')!r} of friction {lane.get('friction')}",
                             "friction 1; `road_friction` of the study's [weather] sets another one")


def is_number(text: str) -> bool:
    """Whether an attribute is a number, not a word or a distribution."""
    try:
        float(text)
    except ValueError:
        return False
    return True


_ACTOR_TAGS = ("vehicle", "trip", "flow", "person", "personFlow")
_VEHICLE_CHILDREN, _PERSON_CHILDREN = ("route", "stop", "param"), ("walk", "personTrip", "stop", "param")
LEGAL_CHILDREN: Mapping[str, tuple[str, ...]] = {
    "routes": ("vType", "route", *_ACTOR_TAGS), "vType": ("param",), "route": ("stop", "param"), "vehicle": _VEHICLE_CHILDREN,
    "trip": ("stop", "param"), "flow": _VEHICLE_CHILDREN, "person": _PERSON_CHILDREN, "personFlow": _PERSON_CHILDREN,
    "walk": ("param",), "personTrip": ("param",), "stop": ("param",), "param": (),
}
"""Legal children of the elements of a traffic file."""
EXTERNAL_REFERENCES = frozenset({
    "fromTaz", "toTaz", "fromJunction", "toJunction", "busStop", "trainStop", "containerStop", "chargingStation",
    "parkingArea", "overheadWireSegment", "lines", "line", "group", "departEdge", "arrivalEdge", "imgFile", "osgFile"})
"""Attributes that refer to elements or files outside a traffic file."""
DEVICE_PARAMETERS = re.compile(r"(has\.|device\.).*")
"""Parameters of devices; devices write files or use random numbers."""
RANDOM_ATTRIBUTES = frozenset({"lcSigma", "jmIgnoreFoeProb", "jmIgnoreJunctionFoeProb", "jmSigmaMinor", "probability"})
"""Attributes that introduce randomness unless they are 0."""
SIGMA_MODELS = frozenset({"Krauss", "KraussOrig1", "KraussPS"})
DETERMINISTIC_MODELS = frozenset({"IDM", "IDMM", "ACC", "CACC"})
"""Car-following models that are random unless sigma is 0, and models that are never random."""

SETTING_ATTRIBUTES = ("mass", "accel", "decel", "emergencyDecel", "apparentDecel", "maxSpeed", "tau")
"""Attributes of the type of the vehicle under test that the vehicle model replaces by values of the setting."""
DRIVER_ATTRIBUTES = re.compile("carFollowModel|speedFactor|speedDev|sigma.*|desiredMaxSpeed|impatience|laneChangeModel|lc[A-Z].*|jm[A-Z].*"
                             "|actionStepLength|startupDelay|delta|stepping|minGapLat|maxSpeedLat|latAlignment")
"""Attributes of SUMO's own driver."""


def check_demand(root: ElementTree.Element, file: Path, roads: ElementTree.Element, options: Mapping[str, str]) -> None:
    """Refuse traffic that cannot be copied, that would differ between copies, or that does not fit the built network.

    Raises
    ------
    InputError
        Naming the file, the element and its attribute.
    """
    if root.tag != "routes":
        raise InputError(file, f"is a {root.tag!r}", "the traffic of a network, <routes>")
    for parent in root.iter():
        for element in parent:
            if element.tag not in LEGAL_CHILDREN[parent.tag]:
                raise InputError(file, f"{_label(parent)} has a {element.tag!r}", one_of(LEGAL_CHILDREN[parent.tag]) or "nothing")
            _check_element(element, file)
    _check_ids(root, file, roads)
    _check_vut(root, file)
    _check_randomness(root, file, options)
    check_positions(root, file, roads)


def _label(element: ElementTree.Element) -> str:
    return f"{element.tag} {element.get('id')!r}" if "id" in element.attrib else element.tag


def _check_element(element: ElementTree.Element, file: Path) -> None:
    for name, value in element.attrib.items():
        if name in EXTERNAL_REFERENCES:
            raise InputError(file, f"{_label(element)}: {name} = {value!r}", "edges and lanes of the network; no other file is read")
        is_random_position = name.startswith(("depart", "arrival")) and value.startswith("random")
        if is_random_position or (name == "period" and value.startswith("exp")) or (name in RANDOM_ATTRIBUTES and not _is_zero(value)):
            raise InputError(file, f"{_label(element)}: {name} = {value!r} draws at random", "the same in every copy of the network")
    if element.tag == "param" and DEVICE_PARAMETERS.fullmatch(element.get("key", "")):
        raise InputError(file, f"param {element.get('key')!r} gives a device", "no devices: they write files, or draw at random")
    if element.tag in _ACTOR_TAGS and parse_seconds(element.get("depart", element.get("begin", "0"))) is None:
        raise InputError(file, f"{_label(element)}: depart = {element.get('depart', element.get('begin'))!r}", "a time [s]")
    if element.tag in _ACTOR_TAGS and not is_number(element.get("speedFactor", "1")):
        raise InputError(file, f"{_label(element)}: speedFactor = {element.get('speedFactor')!r}", "a number")


def _check_ids(root: ElementTree.Element, file: Path, roads: ElementTree.Element) -> None:
    types, routes = (_unique_ids(root, tags, file) for tags in (("vType",), ("route",)))
    for tags in (("vehicle", "trip", "flow"), ("person", "personFlow")):
        _unique_ids(root, tags, file)
    edges = {edge.get("id", "") for edge in roads.iter("edge")}
    names = {"type": types, "vTypes": types, "route": routes, "edges": edges, "from": edges, "to": edges, "via": edges, "edge": edges,
             "lane": {lane.get("id", "") for lane in roads.iter("lane")}}
    for element in root.iter():
        for name in DEMAND_IDS.get(element.tag, ()):
            for reference in element.get(name, "").split():
                if name in names and reference not in names[name]:
                    raise InputError(file, f"{_label(element)}: {name} = {reference!r} does not exist", _list_names(names[name]))


def _list_names(names: set[str]) -> str:
    visible_names = sorted(name for name in names if not name.startswith(":"))
    return f"one of {', '.join(visible_names[:12])}{', ...' if len(visible_names) > 12 else ''}" if visible_names else "one that is defined"


def _unique_ids(root: ElementTree.Element, tags: tuple[str, ...], file: Path) -> set[str]:
    names: set[str] = set()
    for element in root:
        if element.tag in tags:
            name = element.get("id", "")
            if not name or name in names or name.split() != [name]:
                raise InputError(file, f"{element.tag} has the id {name!r}", "a unique id without spaces")
            names.add(name)
    return names


def _check_vut(root: ElementTree.Element, file: Path) -> None:
    """Refuse traffic unless its vehicle under test departs at time 0, has no stops, and shares its type with no other actor."""
    vut = next((actor for actor in root if actor.tag in ("vehicle", "trip") and actor.get("id") == VUT), None)
    if vut is None:
        raise InputError(file, f"has no vehicle {VUT!r}", f'<vehicle id="{VUT}" type="{VUT}" depart="0" ...>, the vehicle under test')
    if vut.get("type") != VUT:
        raise InputError(file, f"vehicle {VUT!r}: type = {vut.get('type')!r}", f"{VUT!r}, a vType that each setting changes")
    if parse_seconds(vut.get("depart", "")) != 0:
        raise InputError(file, f"vehicle {VUT!r}: depart = {vut.get('depart')!r}", "0")
    routes = [route for route in root if route.tag == "route" and route.get("id") == vut.get("route")]
    if any(element.find(".//stop") is not None for element in (vut, *routes)):
        raise InputError(file, f"vehicle {VUT!r} has a stop", "none: its ADS drives it")
    for element in root:
        if element is not vut and element.get("type") == VUT:
            raise InputError(file, f"{_label(element)}: type = {VUT!r}, which changes with every setting", "a vType of its own")


def _check_randomness(root: ElementTree.Element, file: Path, options: Mapping[str, str]) -> None:
    """Refuse traffic in which SUMO draws random numbers: they differ between copies, so a result would depend on its batch."""
    types = {element.get("id", ""): element for element in root if element.tag == "vType"}
    for actor in root:
        if actor.tag in _ACTOR_TAGS and actor.get("id") != VUT:
            if actor.get("type", "") not in types:
                raise InputError(file, f"{_label(actor)} has no type, and SUMO's default draws at random",
                                 'a vType with speedDev="0" and sigma="0"')
            for problem, legal in _random_parameters(types[actor.get("type", "")], actor, options):
                raise InputError(file, f"vType {actor.get('type')!r} of {_label(actor)} draws at random: {problem}", legal)
    has_persons = root.find("person") is not None or root.find("personFlow") is not None
    dawdling = options.get("pedestrian.striping.dawdling", "SUMO default 0.2")
    if has_persons and options.get("pedestrian.model") != "nonInteracting" and not _is_zero(dawdling):
        raise InputError(file.with_name("scenario.sumocfg"), f"persons dawdle at random: pedestrian.striping.dawdling = {dawdling}", "0")


def _random_parameters(vehicle_type: ElementTree.Element, actor: ElementTree.Element,
                       options: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield each parameter that makes an actor draw random numbers, and a legal value."""
    deviation = vehicle_type.get("speedDev", options.get("default.speeddev"))
    if not is_number(vehicle_type.get("speedFactor", "1")):
        yield f"speedFactor = {vehicle_type.get('speedFactor')!r}", "a number"
    if not is_number(actor.get("speedFactor", "")) and not _is_zero(deviation or "0.1"):
        yield f"speedDev = {deviation or 'SUMO default 0.1'}", 'speedDev="0"'
    if actor.tag in ("person", "personFlow"):
        return
    model = vehicle_type.get("carFollowModel", options.get("default.carfollowmodel", "Krauss"))
    if model in SIGMA_MODELS and not _is_zero(vehicle_type.get("sigma", "0.5")):
        yield f"sigma = {vehicle_type.get('sigma', 'SUMO default 0.5')}", 'sigma="0"'
    elif model not in SIGMA_MODELS | DETERMINISTIC_MODELS:
        yield f"carFollowModel = {model!r}", one_of(SIGMA_MODELS | DETERMINISTIC_MODELS)


def _is_zero(text: str) -> bool:
    return is_number(text) and float(text) == 0


def unused_attribute_remarks(root: ElementTree.Element, roads: ElementTree.Element, max_speed: float, *, sumo_drives: bool) -> list[str]:
    """Remarks on a network's attributes of the vehicle under test that the simulation does not use.

    Parameters
    ----------
    max_speed
        Top speed of the original vehicle; higher speed limits have no effect [m/s].
    sumo_drives
        Whether SUMO's own driver influences the vehicle, as with a controller written for TraCI.
    """
    attributes = []
    for element in (child for child in root if child.get("id") == VUT):
        for name, value in element.attrib.items():
            if name in SETTING_ATTRIBUTES or (DRIVER_ATTRIBUTES.fullmatch(name) and not sumo_drives and not _has_no_effect(name, value)):
                attributes.append(f"{name} = {value}")
    slow_lanes = [] if sumo_drives else [lane for edge in edges_of_vut(root) for lane in roads.findall(f"edge[@id='{edge}']/lane")
                                         if float(lane.get("speed", "inf")) < max_speed]
    if slow_lanes:
        attributes.append(f"the speed limit of lane {slow_lanes[0].get('id')!r} ({float(slow_lanes[0].get('speed', 'nan')):g} m/s)"
                         f"{f' and of {len(slow_lanes) - 1} more' if len(slow_lanes) > 1 else ''}")
    reason = "the study's vehicle and ADS determine how it drives"
    return [f"no effect on vehicle {VUT!r}: {', '.join(dict.fromkeys(attributes))}; {reason}"] if attributes else []


def _has_no_effect(name: str, value: str) -> bool:
    return (name in ("sigma", "speedDev") and _is_zero(value)) or (name == "speedFactor" and is_number(value) and float(value) == 1)
