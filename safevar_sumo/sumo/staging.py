"""A scenario's network with the traffic that its parameters make: a folder like those of `sumo_nets/`, kept in the user's cache."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from functools import cached_property, lru_cache
from pathlib import Path

import platformdirs

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.scenarios import Lane, Scenario
from safevar_sumo.scenarios.base import Actors, lane_through
from safevar_sumo.sumo.copies import parsed
from safevar_sumo.sumo.network import built_network
from safevar_sumo.sumo.sources import OPTIONS, TRAFFIC, Sources, options_of, sources_of


def staged(scenario: Scenario) -> str:
    """The folder of the scenario's network, with its traffic as the scenario's parameters have it.

    Raises
    ------
    InputError
        If the parameters are impossible, or what they change is not in the traffic file.
    """
    actors = getattr(scenario, "actors", None)
    changes = actors(_BuiltRoads(scenario.network)) if actors is not None else {}
    return str(_network_with(sources_of(scenario.network), changes)) if changes else scenario.network


class _BuiltRoads:
    """The lanes of a network as netconvert built it."""

    def __init__(self, network: str) -> None:
        self._network = network

    def lane(self, lane: str) -> Lane:
        if lane not in self._lanes:
            raise InputError(sources_of(self._network).place, f"there is no lane {lane!r}")
        return self._lanes[lane]

    @cached_property
    def _lanes(self) -> dict[str, Lane]:
        network = built_network(self._network)
        return _shapes(network, network.read_bytes())


@lru_cache(maxsize=100)
def _shapes(network: Path, content: bytes) -> dict[str, Lane]:
    shapes = {}
    for lane in ElementTree.fromstring(content).iter("lane"):
        points = [(float(x), float(y)) for x, y in (point.split(",")[:2] for point in lane.attrib["shape"].split())]
        shapes[lane.attrib["id"]] = lane_through(lane.attrib["id"], points)
    return shapes


def _network_with(sources: Sources, actors: Actors) -> Path:
    """A copy of a network with changes to its traffic."""
    place = sources.place
    root = parsed(place / TRAFFIC)
    for path, attributes in actors.items():
        found = root.findall(path)
        if not found:
            raise InputError(place / TRAFFIC, f"has no {path}")
        for element in found:
            if attributes is None:
                root.remove(element)
            else:
                element.attrib.update(attributes)
    return _kept(sources, ElementTree.tostring(root), sources.contents(*sources.files)) / sources.built


@lru_cache(maxsize=1000)
def _kept(sources: Sources, traffic: bytes, contents: tuple[bytes, ...]) -> Path:
    place = sources.place
    digest = hashlib.sha256(repr((sources.files, traffic, contents)).encode()).hexdigest()
    target = platformdirs.user_cache_path("safevar_sumo") / "staged" / digest[:16] / (place.name or "network")
    if not target.is_dir():
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=target.parent) as folder:
                copy = Path(folder) / target.name
                copy.mkdir()
                for name in (*sources.files, options_of(place / OPTIONS).get("gui-settings-file", "")):
                    if (place / name).is_file():
                        shutil.copy2(place / name, copy / name)
                (copy / TRAFFIC).write_bytes(traffic)
                os.replace(copy, target)
        except OSError as error:
            if not target.is_dir():
                raise SimulationError(f"{target}: cannot write the cache of networks: {error.strerror}") from None
    return target
