"""Variants of a network in the user's cache, with the lanes and traffic that a scenario's parameters require."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import GuardedScenario, Lane, Scenario
from safevar_sumo.scenarios.base import XmlChanges, lane_through
from safevar_sumo.sumo.cache import ensure_all_cached
from safevar_sumo.sumo.copies import parse_xml
from safevar_sumo.sumo.network import (
    NETWORK_FILE,
    OPTIONS_FILE,
    TRAFFIC_FILE,
    Network,
    built_network,
    open_network,
    options_of,
)


def stage_network(scenario: Scenario) -> Network:
    """The scenario's network, with lanes and traffic changed by the scenario's parameters.

    Raises
    ------
    InputError
        If the parameters are impossible, or change an element that the network or the traffic file lacks.
    EnvironmentFault
        If the cache cannot be written.
    """
    return stage_networks([scenario])[0]


def stage_networks(scenarios: Sequence[Scenario]) -> list[Network]:
    """The networks of several scenarios, whose files are read once per network; raises the errors of
    `stage_network`.
    """
    networks = {name: open_network(name) for name in {scenario.network for scenario in scenarios}}

    def stage(scenario: Any) -> Network:
        may_vary = isinstance(scenario, GuardedScenario)  # a user's scenario may return different changes in each call
        return (_stage.__wrapped__ if may_vary else _stage)(scenario, networks[scenario.network])

    return [stage(scenario) for scenario in scenarios]


@lru_cache(maxsize=10_000)
def _stage(scenario: Scenario, network: Network) -> Network:
    if changes := scenario.lanes(_BuiltRoads(network)):
        network = _variant(network, {NETWORK_FILE: _change_xml(built_network(network), changes)})
    if changes := scenario.actors(_BuiltRoads(network)):
        network = _variant(network, {TRAFFIC_FILE: _change_xml(network.path(TRAFFIC_FILE), changes)})
    return network


class _BuiltRoads:
    """The lanes of a built network."""

    def __init__(self, network: Network) -> None:
        self._network = network

    def lane(self, lane: str) -> Lane:
        lanes = _read_lanes(self._network)
        if lane not in lanes:
            raise InputError(self._network.folder, f"there is no lane {lane!r}")
        return lanes[lane]


@lru_cache(maxsize=100)
def _read_lanes(network: Network) -> dict[str, Lane]:
    lanes = {}
    for lane in ElementTree.fromstring(built_network(network).read_bytes()).iter("lane"):
        coordinates = [
            (float(x), float(y)) for x, y in (point.split(",")[:2] for point in lane.attrib["shape"].split())
        ]
        lanes[lane.attrib["id"]] = lane_through(lane.attrib["id"], coordinates)
    return lanes


def _variant(network: Network, changed_files: Mapping[str, bytes]) -> Network:
    """A built network with changed files, in the cache."""
    gui_settings = options_of(network.path(OPTIONS_FILE)).get("gui-settings-file", "")
    sources = {
        NETWORK_FILE: built_network(network),
        **{name: network.path(name) for name in (TRAFFIC_FILE, OPTIONS_FILE, gui_settings)},
    }
    contents = {name: changed_files.get(name) or file.read_bytes() for name, file in sources.items() if file.is_file()}
    return _store_network(network.folder.name, tuple(contents.items()))


@lru_cache(maxsize=1000)
def _store_network(name: str, files: tuple[tuple[str, bytes], ...]) -> Network:
    folder = f"staged-{hashlib.sha256(repr(files).encode()).hexdigest()[:16]}/{name or 'network'}"
    return open_network(str(ensure_all_cached(folder, [file for file, _ in files], partial(_write_files, files))))


def _change_xml(file: Path, changes: XmlChanges) -> bytes:
    root = parse_xml(file)
    for path, attributes in changes.items():
        elements = root.findall(path)
        if not elements:
            raise InputError(file, f"has no {path}")
        for element in elements:
            if attributes is None:
                root.remove(element)
            else:
                element.attrib.update(attributes)
    return ElementTree.tostring(root)


def _write_files(files: tuple[tuple[str, bytes], ...], into: Path) -> None:
    for name, content in files:
        (into / name).write_bytes(content)
