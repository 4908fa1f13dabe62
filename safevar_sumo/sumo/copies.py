"""Writes N copies of a network and its traffic as XML: each id begins with the number of its copy.
And the user's cache folder, which keeps such files.
"""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import platformdirs

from safevar_sumo.errors import EnvironmentFault, InputError
from safevar_sumo.output import temporary_folder

ROAD_IDS: Mapping[str, tuple[str, ...]] = {
    "edge": ("id", "from", "to", "crossingEdges", "bidi"),
    "lane": ("id",),
    "neigh": ("lane",),
    "stopOffset": (),
    "tlLogic": ("id",),
    "phase": (),
    "junction": ("id", "incLanes", "intLanes"),
    "request": (),
    "connection": ("from", "to", "via", "tl"),
    "roundabout": ("nodes", "edges"),
    "param": (),
}
"""Elements of a built network, with their attributes that contain ids."""
SHARED_ELEMENTS = ("location", "type", "prohibition")
"""Elements of a built network that all copies share. SUMO does not read prohibitions from a built
network, because junctions state them, too.
"""
DEMAND_IDS: Mapping[str, tuple[str, ...]] = {
    "vType": ("id",),
    "route": ("id", "edges"),
    "vehicle": ("id", "type", "route", "via"),
    "trip": ("id", "type", "from", "to", "via"),
    "flow": ("id", "type", "route", "from", "to", "via"),
    "person": ("id", "type"),
    "personFlow": ("id", "type"),
    "walk": ("edges", "route", "from", "to"),
    "personTrip": ("from", "to", "via", "vTypes"),
    "stop": ("lane", "edge", "expected", "permitted", "join", "split"),
    "param": (),
}
"""Elements of a traffic file, with their attributes that contain ids."""
_COPY_PLACEHOLDER = "\x01"
"""Placeholder for the number of a copy; XML cannot contain this character."""


def copied_id(copy: int | str, name: str) -> str:
    """The id of the element `name` in a copy, such as "3.car"; the ids of internal edges keep their
    leading colon (":3.junction").
    """
    if name.startswith(":"):
        return f":{copy}.{name[1:]}"
    return f"{copy}.{name}"


_marked_id = partial(copied_id, _COPY_PLACEHOLDER)


def copy_and_name(copied: str) -> tuple[int, str]:
    """The number of the copy to which an id belongs, and the name in the original network: the
    inverse of `copied_id`.
    """
    colon = ":" if copied.startswith(":") else ""
    copy, _, name = copied.removeprefix(":").partition(".")
    return int(copy), colon + name


def parse_xml(source: Path) -> ElementTree.Element:
    """The root of an XML file.

    Raises
    ------
    InputError
        If the file cannot be read, or is not XML.
    """
    try:
        return ElementTree.parse(source).getroot()
    except (OSError, ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(source, f"is not XML: {error}") from None


def write_roads(root: ElementTree.Element, n: int, file: Path) -> None:
    """Write `n` copies of a built network. Copies are interleaved tag by tag, because SUMO requires
    all edges before junctions, and junctions before connections.

    Raises
    ------
    InputError
        If an element cannot be copied.
    """
    blocks = []
    for tag, children in groupby(root, key=lambda child: child.tag):
        if tag in SHARED_ELEMENTS:
            for child in children:
                blocks.append(ElementTree.tostring(child, encoding="unicode"))
        else:
            elements = "".join(_marked_xml(child, ROAD_IDS) for child in children)
            for copy in range(n):
                blocks.append(elements.replace(_COPY_PLACEHOLDER, str(copy)))
    _write(root, blocks, file)


def write_demand(roots: Sequence[ElementTree.Element], n: int, file: Path) -> None:
    """Write `n` copies of traffic in the order of departure, because SUMO drops actors that come
    too late in the file. `roots` has one traffic for all copies, or one for each.

    Raises
    ------
    InputError
        If an element cannot be copied.
    """
    traffics = [list(_departures(root)) for root in roots]
    departures = []
    for copy in range(n):
        for time, text in traffics[copy % len(roots)]:
            departures.append((time, text.replace(_COPY_PLACEHOLDER, str(copy))))
    departures.sort(key=itemgetter(0))
    _write(roots[0], (element for _, element in departures), file)


def _departures(root: ElementTree.Element) -> Iterable[tuple[float, str]]:
    """Yield the departure time [s] of each child of a traffic file, and its XML with a placeholder
    in every id. Types and routes get the time -1, so that they come first.
    """
    time = 0.0
    for child in root:
        if child.tag in ("vType", "route"):
            yield -1.0, _marked_xml(child, DEMAND_IDS)
        else:
            time = parse_seconds(child.get("depart", child.get("begin", ""))) or time
            yield time, _marked_xml(child, DEMAND_IDS)


def parse_seconds(text: str) -> float | None:
    """Convert a time in SUMO's format, seconds or [days:]hours:minutes:seconds, into seconds.
    Returns None if the text is no time.
    """
    try:
        total = 0.0
        fields = text.split(":")
        # The last field has seconds, the field before it minutes, and so on.
        units = (86400, 3600, 60, 1)[-len(fields) :]
        for seconds, field in zip(units, fields, strict=True):
            total += seconds * float(field)
    except ValueError:
        return None
    if math.isfinite(total):
        return total
    return None


def _marked_xml(
    element: ElementTree.Element, ids: Mapping[str, tuple[str, ...]]
) -> str:
    """The XML of an element, with a placeholder in every id. The element itself is changed."""
    for part in element.iter():
        if part.tag not in ids:
            raise InputError(
                "",
                f"has a {part.tag!r}, which cannot be copied for every vehicle",
                ", ".join(ids),
            )
        for name in set(ids[part.tag]) & part.attrib.keys():
            marked_ids = (_marked_id(name) for name in part.attrib[name].split())
            part.set(name, " ".join(marked_ids))
    return ElementTree.tostring(element, encoding="unicode")


def _write(root: ElementTree.Element, blocks: Iterable[str], file: Path) -> None:
    """Write a file with `blocks` of XML inside the tag of the root. Attributes of the root stay,
    except attributes of a namespace.
    """
    attributes = {
        name: value for name, value in root.attrib.items() if not name.startswith("{")
    }
    empty_text = ElementTree.tostring(
        ElementTree.Element(root.tag, attributes),
        encoding="unicode",
        short_empty_elements=False,
    )
    head, _, tail = empty_text.rpartition("</")
    file.write_text(
        f"<?xml version='1.0' encoding='utf-8'?>\n{head}{''.join(blocks)}</{tail}",
        encoding="utf-8",
    )


def ensure_cached(folder: str, name: str, build: Callable[[Path], None]) -> Path:
    """The path of a file in a folder of the cache; `build` writes the file if it does not exist.

    Parameters
    ----------
    folder
        Folder in the cache; different contents need different folders.
    build
        Function that writes the file into a given directory.

    Raises
    ------
    EnvironmentFault
        If the cache cannot be written.
    """
    target = platformdirs.user_cache_path("safevar_sumo") / "networks" / folder
    if (target / name).is_file():
        return target / name

    # Another process must never see a part of the folder, so that it is renamed when complete.
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(target.parent) as temporary:
            new = Path(temporary, "new")
            new.mkdir()
            build(new)
            # Without this, a power failure after the renaming could leave an empty file.
            with (new / name).open("rb+") as file:
                os.fsync(file.fileno())
            new.rename(target)
    except OSError as error:
        # Another process may have been faster.
        if not (target / name).is_file():
            raise EnvironmentFault(
                f"{target}: cannot write the cache of networks: {error.strerror or error}"
            ) from None
    return target / name
