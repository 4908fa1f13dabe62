"""Copies of the XML of a network and its traffic: every id is prefixed with the copy's number."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path

from safevar_sumo.errors import InputError

Ids = Mapping[str, tuple[str, ...]]
"""Attributes that hold ids, by element; an attribute may hold several, separated by spaces."""

ROADS: Ids = {
    "edge": ("id", "from", "to", "crossingEdges", "bidi"), "lane": ("id",), "neigh": ("lane",), "stopOffset": (),
    "tlLogic": ("id",), "phase": (), "junction": ("id", "incLanes", "intLanes"), "request": (),
    "connection": ("from", "to", "via", "tl"), "roundabout": ("nodes", "edges"), "param": (),
}
"""Elements of a built network."""
SHARED = ("location", "type", "prohibition")
"""Elements of a built network that are written once for all copies; SUMO ignores prohibitions, as its junctions contain them."""
DEMAND: Ids = {
    "vType": ("id",), "route": ("id", "edges"), "vehicle": ("id", "type", "route", "via"),
    "trip": ("id", "type", "from", "to", "via"),
    "flow": ("id", "type", "route", "from", "to", "via"),
    "person": ("id", "type"), "personFlow": ("id", "type"), "walk": ("edges", "route", "from", "to"),
    "personTrip": ("from", "to", "via", "vTypes"),
    "stop": ("lane", "edge", "expected", "permitted", "join", "split"), "param": (),
}
"""Elements of a traffic file."""
SIGNALS = re.compile(
    r"(max|min|detector)-gap|passing-time|show-detectors|freq|(jam|inactive)-threshold|coordinated|cycleTime|cycleOffset|link(Max|Min)Dur:\d+"
    r"|minTimeLoss|detectorRange|ring[12]|barrier2?Phases|coordinate-mode|whetherOutputState|fixForceOff|controllerType|total-cycle-length")
"""Parameters of a traffic light that refer to no detectors or files."""
_COPY = "\x01"
"""Placeholder for the copy's number; XML cannot contain this character."""


def copied_id(copy: int | str, name: str) -> str:
    """Id of `name` in a copy; internal edges keep their leading colon."""
    return f":{copy}.{name[1:]}" if name.startswith(":") else f"{copy}.{name}"


def copy_and_name(copied: str) -> tuple[int, str]:
    """The copy that an id belongs to and its name in the original: the inverse of `copied_id`."""
    colon = ":" if copied.startswith(":") else ""
    copy, _, name = copied.removeprefix(":").partition(".")
    return int(copy), colon + name


def parsed(source: Path) -> ElementTree.Element:
    """The root of an XML file.

    Raises
    ------
    InputError
        If it is not XML.
    """
    try:
        return ElementTree.parse(source).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(source, f"is not XML: {error}") from None


def write_roads(root: ElementTree.Element, n: int, file: Path) -> None:
    """Write N copies of a built network, kind by kind: SUMO requires edges before junctions, and junctions before connections."""
    parts = []
    for tag, children in groupby(root, key=lambda child: child.tag):
        elements = "".join(_text(child, {} if tag in SHARED else ROADS) for child in children)
        parts.append(elements if tag in SHARED else _times(elements, n))
    _write(root, parts, file)


def write_demand(original: ElementTree.Element, n: int, file: Path) -> None:
    """Write N copies of a traffic in the order of departure: SUMO drops actors that come too late in the file."""
    texts = [(begin, _text(child, DEMAND)) for child, begin in _departures(original)]
    copies = sorted(((begin, copy, text) for copy in range(n) for begin, text in texts), key=lambda entry: entry[0])
    _write(original, [text.replace(_COPY, str(copy)) for _, copy, text in copies], file)


def check_roads(root: ElementTree.Element, file: Path) -> None:
    """Refuse elements of a built network that cannot be copied.

    Raises
    ------
    InputError
        Naming the file and the element.
    """
    if root.tag != "net":
        raise InputError(file, f"is a {root.tag!r}", "a network of SUMO, <net>")
    for child in root:
        for element in [child] if child.tag in SHARED else child.iter():
            if element.tag not in ROADS and child.tag not in SHARED:
                raise InputError(file, f"has a {element.tag!r}", f"{', '.join([*ROADS, *SHARED])}")
        if child.tag == "tlLogic":
            _check_signals(child, file)


def _check_signals(light: ElementTree.Element, file: Path) -> None:
    name = light.get("id")
    for element in light:
        if element.tag == "param" and not SIGNALS.fullmatch(element.get("key", "")):
            raise InputError(file, f"traffic light {name!r} has the parameter {element.get('key')!r}",
                             "parameters that name no file, detector or lane")
        if element.tag == "phase" and (element.get("earlyTarget") or element.get("finalTarget")):
            raise InputError(file, f"traffic light {name!r} has phases with conditions", "phases without earlyTarget and finalTarget")


def _departures(root: ElementTree.Element) -> Iterable[tuple[ElementTree.Element, float]]:
    """Children with their time of departure [s]; types and routes come first."""
    last = 0.0
    for child in root:
        if child.tag in ("vType", "route"):
            yield child, -1.0
        else:
            last = seconds(child.get("depart", child.get("begin", ""))) or last
            yield child, last


def seconds(text: str) -> float | None:
    """A time in SUMO's format, seconds or [days:]hours:minutes:seconds, in seconds; None if the text is no time."""
    try:
        total, parts = 0.0, text.split(":")
        for factor, part in zip((86400, 3600, 60, 1)[-len(parts):], parts, strict=True):
            total += factor * float(part)
    except ValueError:
        return None
    return total if math.isfinite(total) else None


def _text(element: ElementTree.Element, ids: Ids) -> str:
    return ElementTree.tostring(_marked(element, ids), encoding="unicode")


def _marked(element: ElementTree.Element, ids: Ids) -> ElementTree.Element:
    attributes = {name: " ".join(copied_id(_COPY, id_) for id_ in value.split()) if name in ids.get(element.tag, ()) else value
                  for name, value in element.attrib.items()}
    result = ElementTree.Element(element.tag, attributes)
    result.text, result.tail = element.text, element.tail
    result.extend(_marked(child, ids) for child in element)
    return result


def _times(text: str, n: int) -> str:
    return "".join(text.replace(_COPY, str(copy)) for copy in range(n))


def _write(root: ElementTree.Element, parts: Sequence[str], file: Path) -> None:
    attributes = {name: value for name, value in root.attrib.items() if not name.startswith("{")}
    empty = ElementTree.tostring(ElementTree.Element(root.tag, attributes), encoding="unicode", short_empty_elements=False)
    head, _, tail = empty.rpartition("</")
    file.write_text(f"<?xml version='1.0' encoding='utf-8'?>\n{head}{''.join(parts)}</{tail}", encoding="utf-8")
