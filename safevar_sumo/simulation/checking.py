"""A network looked at as a whole before anything is simulated on it."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from safevar_sumo.errors import InputError
from safevar_sumo.simulation.copies import check_roads, parsed
from safevar_sumo.simulation.demand import check_demand, unused
from safevar_sumo.simulation.network import ROADS, built_network, network_fingerprint, try_network
from safevar_sumo.simulation.options import TRAFFIC, check_options, options_of
from safevar_sumo.simulation.sources import OPTIONS, Sources, is_shipped, sources_of

SHORTEST_STEP = 0.001
"""SUMO's shortest time step [s]."""
ABOVE_0: Mapping[str, tuple[str, ...]] = {
    "vType": ("length", "width", "height", "maxSpeed", "accel", "decel", "mass"),
    "edge": ("length", "width", "speed"), "lane": ("length", "width", "speed"),
}
FROM_0: Mapping[str, tuple[str, ...]] = {"vType": ("minGap", "tau", "actionStepLength"), "walk": ("speed",)}
"""Attributes of elements that have to be numbers above 0, and from 0 on."""
UNSAID = "-1"
"""What netconvert takes for an attribute that is not there, in its sources."""


def check_network(network: str) -> None:
    """Refuse a network that cannot be simulated as it is meant.

    Raises
    ------
    InputError
        Naming the file, what it says, and what it may say.
    EnvironmentFault
        If the network cannot be built for reasons beside it.
    """
    _check(network, network_fingerprint(network))


def network_remarks(network: str, fastest: float, *, sumo_drives: bool) -> list[str]:
    """What a user's network says and the simulation does not use; see `unused`. Of those that come with the package nobody expects it."""
    if is_shipped(network):
        return []
    file = sources_of(network).place / TRAFFIC
    return [f"{file}: {remark}" for remark in unused(parsed(file), parsed(built_network(network)), fastest, sumo_drives=sumo_drives)]


@lru_cache(maxsize=1000)
def _check(network: str, fingerprint: str) -> None:
    sources = sources_of(network)
    check_options(sources.place / OPTIONS)
    _check_step(sources.place / OPTIONS)
    for name in (*(name for option, names in sources.plain if option == "edge-files" for name in names), TRAFFIC):
        _check_numbers(parsed(sources.place / name), sources.place / name, UNSAID if name != TRAFFIC else "")
    for name in (*sources.roads, TRAFFIC):
        if b"<include" in (sources.place / name).read_bytes():
            raise InputError(sources.place / name, "includes another file", "one file, that holds everything")
    built = built_network(network)
    roads = parsed(built)
    named = built if sources.built else sources.place
    check_roads(roads, named)
    _check_numbers(roads, named)
    _check_edited(sources, built.read_text(encoding="utf-8"))
    check_demand(parsed(sources.place / TRAFFIC), sources.place / TRAFFIC, roads, options_of(sources.place / OPTIONS))
    if not is_shipped(network):
        try_network(network)


def _check_edited(sources: Sources, built: str) -> None:
    """Refuse a network that was drawn on in netedit after its sources, which do not say so."""
    file = sources.place / (sources.builds or ROADS)
    if sources.built or not file.is_file() or any((sources.place / name).stat().st_mtime >= file.stat().st_mtime for name in sources.roads):
        return
    head, _, net = file.read_text(encoding="utf-8", errors="replace").partition("<net ")
    if "netedit" in head and f"<net {net}".strip() != built.strip():
        raise InputError(file, f"was saved by netedit after {', '.join(sources.roads)}, which build another network",
                         "save plain XML there too; or move those files away, to have the network as it is")


def _check_step(file: Path) -> None:
    step = options_of(file).get("step-length", "1")
    if not SHORTEST_STEP <= _number(step) < math.inf:
        raise InputError(file, f"step-length = {step!r}", f"a number from {SHORTEST_STEP} on [s]")


def _check_numbers(root: ElementTree.Element, file: Path, unsaid: str = "") -> None:
    """Refuse lengths, speeds and accelerations that nothing can have."""
    for element in root.iter():
        for names, above, legal in ((ABOVE_0, True, "a number above 0"), (FROM_0, False, "a number from 0 on")):
            for name in names.get(element.tag, ()):
                text = element.get(name, unsaid)
                if text == unsaid or (number := _number(text)) > 0 or (number == 0 and not above):
                    continue
                called = f"{element.tag} {element.get('id')!r}" if "id" in element.attrib else element.tag
                raise InputError(file, f"{called}: {name} = {text!r}", legal)


def _number(text: str) -> float:
    """A finite number, or -infinity for what is none."""
    try:
        found = float(text)
    except ValueError:
        return -math.inf
    return found if math.isfinite(found) else -math.inf
