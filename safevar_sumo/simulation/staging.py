"""A scenario's network with the traffic that its parameters make: a folder like those of `sumo_nets/`, kept in the user's cache."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from functools import cache, lru_cache
from pathlib import Path

import platformdirs

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.scenarios import Lane, Scenario
from safevar_sumo.scenarios.base import Actors
from safevar_sumo.simulation.network import TRAFFIC, copied_id, copied_network, folder_of, parsed


def staged(scenario: Scenario) -> str:
    """The folder of the scenario's network, with its traffic as the scenario's parameters have it.

    Raises
    ------
    InputError
        If the parameters are impossible, or what they change is not in the traffic file.
    """
    actors = getattr(scenario, "actors", None)
    changes = actors(_BuiltRoads(scenario.network)) if actors is not None else {}
    return str(_folder_with(folder_of(scenario.network), changes)) if changes else scenario.network


class _BuiltRoads:
    """The lanes of a network as netconvert built it."""

    def __init__(self, network: str) -> None:
        self._network = network

    def lane(self, lane: str) -> Lane:
        shapes = _shapes(copied_network(self._network, 1).network)
        if copied_id(0, lane) not in shapes:
            raise InputError(folder_of(self._network), f"there is no lane {lane!r}")
        return shapes[copied_id(0, lane)]


@cache
def _shapes(network: Path) -> dict[str, Lane]:
    shapes = {}
    for lane in parsed(network).iter("lane"):
        points = [tuple(map(float, point.split(",")[:2])) for point in lane.attrib["shape"].split()]
        shapes[lane.attrib["id"]] = Lane(points[0], points[-1])  # type: ignore[arg-type]
    return shapes


def _folder_with(place: Path, actors: Actors) -> Path:
    """A copy of a network's folder with changes to its traffic."""
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
    return _kept(place, ElementTree.tostring(root))


@lru_cache(maxsize=1000)
def _kept(place: Path, traffic: bytes) -> Path:
    digest = hashlib.sha256(b"".join([traffic, *(file.read_bytes() for file in sorted(place.iterdir()) if file.is_file())])).hexdigest()
    target = platformdirs.user_cache_path("safevar_sumo") / "staged" / digest[:16] / place.name
    if not target.is_dir():
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=target.parent) as folder:
                copy = Path(folder) / place.name
                shutil.copytree(place, copy)
                (copy / TRAFFIC).write_bytes(traffic)
                os.replace(copy, target)
        except OSError as error:
            if not target.is_dir():
                raise SimulationError(f"{target}: cannot write the cache of networks: {error.strerror}") from None
    return target
