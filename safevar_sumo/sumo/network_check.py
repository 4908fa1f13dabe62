"""Whether a network can be simulated correctly: checks of its files before the first simulation, and remarks on what is not used."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from safevar_sumo.errors import InputError
from safevar_sumo.sumo.copies import check_roads, parse_xml
from safevar_sumo.sumo.demand import check_demand, unused_attribute_remarks
from safevar_sumo.sumo.network import NETWORK_FILE, built_network, network_fingerprint, try_network
from safevar_sumo.sumo.sources import OPTIONS_FILE, TRAFFIC_FILE, Sources, check_options, is_shipped, options_of, sources_of

SHORTEST_STEP, LONGEST_STEP = 0.001, 1.0
"""SUMO's shortest time step, and the longest step in which a vehicle can still react in time [s]."""
POSITIVE_NUMBERS: Mapping[str, tuple[str, ...]] = {
    "vType": ("length", "width", "height", "maxSpeed", "accel", "decel", "mass"),
    "edge": ("length", "width", "speed"), "lane": ("length", "width", "speed"),
}
NON_NEGATIVE_NUMBERS: Mapping[str, tuple[str, ...]] = {"vType": ("minGap", "tau", "actionStepLength"), "walk": ("speed",)}
"""Attributes, by element, that must be positive, and attributes that must not be negative."""
UNSET_VALUE = "-1"
"""Value that marks an attribute in netconvert's sources as not set."""


def check_network(network: str) -> None:
    """Refuse a network that cannot be simulated correctly.

    Raises
    ------
    InputError
        Naming the file, the illegal value and the legal values.
    EnvironmentFault
        If netconvert fails for reasons outside the network.
    """
    _check_files(network, network_fingerprint(network))


def network_remarks(network: str, max_speed: float, *, sumo_drives: bool) -> list[str]:
    """Remarks on parts of a user's network that the simulation does not use; no remarks on shipped networks."""
    if is_shipped(network):
        return []
    file = sources_of(network).folder / TRAFFIC_FILE
    roots = parse_xml(file), parse_xml(built_network(network))
    return [f"{file}: {remark}" for remark in unused_attribute_remarks(*roots, max_speed, sumo_drives=sumo_drives)]


@lru_cache(maxsize=1000)
def _check_files(network: str, fingerprint: str) -> None:
    sources = sources_of(network)
    check_options(sources.folder / OPTIONS_FILE)
    _check_step(sources.folder / OPTIONS_FILE)
    for name in (*(name for option, names in sources.plain_files if option == "edge-files" for name in names), TRAFFIC_FILE):
        _check_numbers(parse_xml(sources.folder / name), sources.folder / name, UNSET_VALUE if name != TRAFFIC_FILE else "")
    for name in (*sources.road_files, TRAFFIC_FILE):
        if b"<include" in (sources.folder / name).read_bytes():
            raise InputError(sources.folder / name, "includes another file", "one file that contains everything")
    network_file = built_network(network)
    roads = parse_xml(network_file)
    error_source = network_file if sources.network_file else sources.folder
    check_roads(roads, error_source)
    _check_numbers(roads, error_source)
    _check_edits(sources, network_file.read_text(encoding="utf-8"))
    check_demand(parse_xml(sources.folder / TRAFFIC_FILE), sources.folder / TRAFFIC_FILE, roads, options_of(sources.folder / OPTIONS_FILE))
    if not is_shipped(network):
        try_network(network)


def _check_edits(sources: Sources, built_text: str) -> None:
    """Refuse a network that was edited in netedit while its sources were not."""
    file = sources.folder / (sources.output_file or NETWORK_FILE)
    names = sources.road_files
    if sources.network_file or not file.is_file() or any((sources.folder / name).stat().st_mtime >= file.stat().st_mtime for name in names):
        return
    header, _, network = file.read_text(encoding="utf-8", errors="replace").partition("<net ")
    if "netedit" in header and f"<net {network}".strip() != built_text.strip():
        raise InputError(file, f"has edits by netedit that {', '.join(names)} do not have",
                         "those files saved from netedit as plain XML, too; or a folder without those files, so that this network is used")


def _check_step(file: Path) -> None:
    step = options_of(file).get("step-length", "1")
    if not SHORTEST_STEP <= _parse_number(step) <= LONGEST_STEP:
        raise InputError(file, f"step-length = {step!r}", f"a number from {SHORTEST_STEP:g} to {LONGEST_STEP:g} [s]")


def _check_numbers(root: ElementTree.Element, file: Path, unset_value: str = "") -> None:
    """Refuse impossible lengths, speeds and accelerations."""
    for element in root.iter():
        for names, positive, legal in ((POSITIVE_NUMBERS, True, "a number above 0"), (NON_NEGATIVE_NUMBERS, False, "a number from 0 on")):
            for name in names.get(element.tag, ()):
                text = element.get(name, unset_value)
                if text == unset_value or (number := _parse_number(text)) > 0 or (number == 0 and not positive):
                    continue
                label = f"{element.tag} {element.get('id')!r}" if "id" in element.attrib else element.tag
                raise InputError(file, f"{label}: {name} = {text!r}", legal)


def _parse_number(text: str) -> float:
    """The number in a text, or -infinity if the text is no finite number."""
    try:
        number = float(text)
    except ValueError:
        return -math.inf
    return number if math.isfinite(number) else -math.inf
