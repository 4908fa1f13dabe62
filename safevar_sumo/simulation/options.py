"""Which options a network's folder may set: none that writes a file, opens a socket, draws at random or reads from elsewhere."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from safevar_sumo.errors import InputError

SECTIONS = frozenset({
    "configuration", "input", "time", "processing", "report", "gui_only", "random_number", "routing", "output", "projection",
    "building_defaults", "tls_building", "ramp_guessing", "edge_removal", "unregulated_nodes", "junctions", "pedestrian", "bicycle",
    "railway", "formats"})
SIMULATING = re.compile(
    r"net-file|route-files|gui-settings-file|begin|step-length|step-method\.ballistic|lateral-resolution|seed|max-depart-delay"
    r"|(collision|intermodal-collision|pedestrian|default|time-to-teleport|emergencydecel)(\.[a-z-]+)+|time-to-teleport"
    r"|ignore-junction-blocker|ignore-accidents|no-internal-links|lanechange\.duration|no-warnings|no-step-log|verbose")
"""SUMO's: they say how vehicles and persons move, or which of the folder's own files are read."""
BUILDING = re.compile(
    r"precision|simple-projection|proj\.(scale|rotate|utm|dhdn|inverse|dhdnutm)|speed-in-kmh|flatten|lefthand|flip-y-axis|join-lanes"
    r"|max-join-ids|dismiss-vclasses|construction-date|numerical-ids|plain\.extend-edge-shape|no-internal-links|no-left-connections"
    r"|no-turnarounds(\.[a-z]+)?|rectangular-lane-cut|ignore-widths|ignore-change-restrictions|discard-params|ignore-errors(\.[a-z-]+)?"
    r"|keep-nodes-unregulated(\.[a-z-]+)?|walkingareas|(geometry|offset|roundabouts|opposites|fringe|speed|edges|default|tls|ramps"
    r"|keep-edges|remove-edges|keep-lanes|junctions|internal-junctions|check-lane-foes|sidewalks|crossings|walkingareas|bikelanes"
    r"|railway|osm|opendrive)(\.[a-zA-Z-]+)+(?<!file)(?<!output)")
"""Netconvert's: they say what becomes of the sources."""
SOURCES = ("sumo-net-file", "osm-files", "opendrive-files", "node-files", "edge-files", "connection-files", "type-files",
           "tllogic-files", "polygon-files")
"""Netconvert's, with the names of files that a network is built from."""
TELLING = re.compile(r"output-file|verbose|print-options|no-warnings|aggregate-warnings|xml-validation(\.net)?|write-license|write-metadata"
                     r"|log\.(timestamps|processid)|human-readable-time")
"""Netconvert's that change nothing of what is built; the network is written where the tool wants it."""
TRAFFIC = "traffic.rou.xml"


def options_of(file: Path) -> dict[str, str]:
    """The options that a configuration of SUMO or netconvert sets.

    Raises
    ------
    InputError
        If it is no such configuration, or says one thing twice.
    """
    try:
        root = ElementTree.fromstring(file.read_bytes())
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(file, f"cannot be read: {error}", "a configuration of SUMO") from None
    found: dict[str, str] = {}
    for element in root.iter():
        if "value" in element.attrib and element is not root:
            if element.tag in found:
                raise InputError(file, f"sets {element.tag!r} twice", "each option once")
            found[element.tag] = element.attrib["value"].strip()
        elif element is not root and element.tag not in SECTIONS:
            raise InputError(file, f"sets SUMO's option {element.tag!r} without value=", f'<{element.tag} value="..."/>')
    return found


def check_options(file: Path) -> None:
    """Refuse a configuration of SUMO with an option that is not on the list.

    Raises
    ------
    InputError
        Naming the file and the option.
    """
    given = options_of(file)
    for name in given:
        if not SIMULATING.fullmatch(name):
            raise InputError(file, f"sets SUMO's option {name!r}", "options that write no file, open no socket and draw nothing at random, "
                             "such as step-length, collision.* and pedestrian.*")
    for name in ("net-file", "gui-settings-file"):
        own_files(file, name, given.get(name, ""))
    if given.get("route-files", TRAFFIC) != TRAFFIC:
        raise InputError(file, f"route-files = {given['route-files']!r}", f"{TRAFFIC}, all traffic in one file")


def recipe_of(file: Path) -> tuple[dict[str, tuple[str, ...]], dict[str, str], str]:
    """Sources by netconvert's option, the options that shape what is built, and the name of the network that the recipe writes.

    Raises
    ------
    InputError
        Naming the file and an option that a recipe may not set.
    """
    sources, options = dict[str, tuple[str, ...]](), dict[str, str]()
    given = options_of(file)
    for name, value in given.items():
        if name in SOURCES:
            sources[name] = own_files(file, name, value)
        elif BUILDING.fullmatch(name):
            options[name] = value
        elif not TELLING.fullmatch(name):
            raise InputError(file, f"sets netconvert's option {name!r}", f"options that shape the network, such as junctions.*, tls.* and "
                             f"no-turnarounds, and its sources: {', '.join(SOURCES)}")
    return sources, options, given.get("output-file", "")


def own_files(file: Path, name: str, value: str) -> tuple[str, ...]:
    """The files beside a configuration that an option of it names.

    Raises
    ------
    InputError
        If it names one that is not beside it.
    """
    found = tuple(one.strip() for one in value.split(",") if one.strip())
    for one in found:
        if Path(one).name != one or "\\" in one:
            raise InputError(file, f"{name} = {one!r} is in another folder", "the name of a file beside it")
        if name in SOURCES and not (file.parent / one).is_file():
            raise InputError(file, f"{name}: {one} is missing", "a file beside it")
    return found
