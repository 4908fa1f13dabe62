"""Variants of a network in the user's cache, with the lanes and traffic that a scenario's parameters require."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import GuardedScenario, Lane, Scenario
from safevar_sumo.scenarios.base import XmlChanges, lane_through
from safevar_sumo.sumo.cache import ensure_all_cached
from safevar_sumo.sumo.copies import parse_xml
from safevar_sumo.sumo.network import NETWORK_FILE, built_network, network_fingerprint
from safevar_sumo.sumo.sources import OPTIONS_FILE, TRAFFIC_FILE, Sources, options_of, sources_of


class StagedNetwork(NamedTuple):
    """A network with a scenario's lanes and traffic: its folder (or `.net.xml` file), and a digest of its content."""

    folder: str
    fingerprint: str


def stage_network(scenario: Scenario) -> StagedNetwork:
    """The scenario's network, with lanes and traffic changed by the scenario's parameters.

    Raises
    ------
    InputError
        If the parameters are impossible, or change an element that the network or the traffic file lacks.
    EnvironmentFault
        If the cache cannot be written.
    """
    return stage_networks([scenario])[0]


def stage_networks(scenarios: Sequence[Scenario]) -> list[StagedNetwork]:
    """The networks of several scenarios, whose files are read once per network; raises the errors of `stage_network`."""
    fingerprints = {name: network_fingerprint(name) for name in {scenario.network for scenario in scenarios}}
    def stage(scenario: Any) -> StagedNetwork:
        may_vary = isinstance(scenario, GuardedScenario)  # a user's scenario may return different changes in each call
        return (_stage.__wrapped__ if may_vary else _stage)(scenario, fingerprints[scenario.network])

    return [stage(scenario) for scenario in scenarios]


@lru_cache(maxsize=10_000)
def _stage(scenario: Any, fingerprint: str) -> StagedNetwork:
    """The staged network; `fingerprint` makes the contents of the network's files part of the cache key."""
    folder = scenario.network
    lanes, actors = (getattr(scenario, name, None) for name in ("lanes", "actors"))
    if lanes is not None and (changes := lanes(_BuiltRoads(folder, fingerprint))):
        folder = str(_change_lanes(sources_of(folder), built_network(folder), changes))
        fingerprint = network_fingerprint(folder)
    if actors is not None and (changes := actors(_BuiltRoads(folder, fingerprint))):
        folder = str(_change_traffic(sources_of(folder), changes))
        fingerprint = network_fingerprint(folder)
    return StagedNetwork(folder, fingerprint)


class _BuiltRoads:
    """The lanes of a built network."""

    def __init__(self, network: str, fingerprint: str) -> None:
        self._network, self._fingerprint = network, fingerprint

    def lane(self, lane: str) -> Lane:
        lanes = _read_lanes(self._network, self._fingerprint)
        if lane not in lanes:
            raise InputError(sources_of(self._network).folder, f"there is no lane {lane!r}")
        return lanes[lane]


@lru_cache(maxsize=100)
def _read_lanes(network: str, fingerprint: str) -> dict[str, Lane]:
    lanes = {}
    for lane in ElementTree.fromstring(built_network(network).read_bytes()).iter("lane"):
        coordinates = [(float(x), float(y)) for x, y in (point.split(",")[:2] for point in lane.attrib["shape"].split())]
        lanes[lane.attrib["id"]] = lane_through(lane.attrib["id"], coordinates)
    return lanes


def _change_lanes(sources: Sources, network_file: Path, changes: XmlChanges) -> Path:
    """A copy of a built network with changes to its lanes."""
    files = {NETWORK_FILE: ElementTree.tostring(_change_xml(network_file, changes)), **_read_files(sources, TRAFFIC_FILE, OPTIONS_FILE)}
    return _store_network(sources.folder.name, tuple(files.items()))


def _change_traffic(sources: Sources, changes: XmlChanges) -> Path:
    """A copy of a network, or of its sources, with changes to its traffic."""
    files = _read_files(sources, *sources.files) | {TRAFFIC_FILE: ElementTree.tostring(_change_xml(sources.folder / TRAFFIC_FILE, changes))}
    return _store_network(sources.folder.name, tuple(files.items())) / sources.network_file


def _read_files(sources: Sources, *names: str) -> dict[str, bytes]:
    """Contents of the named files of a network, and of its settings of sumo-gui."""
    gui_settings = options_of(sources.folder / OPTIONS_FILE).get("gui-settings-file", "")
    return {name: (sources.folder / name).read_bytes() for name in (*names, gui_settings) if (sources.folder / name).is_file()}


def _change_xml(file: Path, changes: XmlChanges) -> ElementTree.Element:
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
    return root


@lru_cache(maxsize=1000)
def _store_network(name: str, files: tuple[tuple[str, bytes], ...]) -> Path:
    folder = f"staged-{hashlib.sha256(repr(files).encode()).hexdigest()[:16]}/{name or 'network'}"
    return ensure_all_cached(folder, [file for file, _ in files], partial(_write_files, files))


def _write_files(files: tuple[tuple[str, bytes], ...], into: Path) -> None:
    for name, content in files:
        (into / name).write_bytes(content)
