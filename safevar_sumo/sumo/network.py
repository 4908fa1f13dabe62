"""SUMO networks: their folders, and N copies of a network and its traffic. The copies have the same
coordinates, and no connection with each other.

A folder has a network, its traffic, and SUMO's options. The network is built (`.net.xml`), or a
recipe (`.netccfg`) from which netconvert builds it. Shipped networks have both, and are used as
built, so that only a user's recipe needs netconvert (extra `sumo`). The user's cache folder keeps
built networks and copies, in folders named by the content of the sources.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import (
    EnvironmentFault,
    InputError,
    about,
    did_you_mean,
    missing_extra,
)
from safevar_sumo.output import temporary_folder
from safevar_sumo.plugins.files import DIGEST_LENGTH
from safevar_sumo.scenarios import Lane, Scenario
from safevar_sumo.scenarios.base import XmlChanges
from safevar_sumo.scenarios.roads import lane_through
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.sumo import copies
from safevar_sumo.sumo.copies import ensure_cached, parse_xml, write_demand, write_roads

TRAFFIC_FILE = "traffic.rou.xml"
OPTIONS_FILE = "scenario.sumocfg"
NETWORK_FILE = "network.net.xml"
NETWORK_ENDING = ".net.xml"
RECIPE_ENDING = ".netccfg"
LEGAL_FOLDERS = (
    f"a folder with a recipe of netconvert (*{RECIPE_ENDING}) or a *{NETWORK_ENDING}, "
    f"beside {TRAFFIC_FILE} and {OPTIONS_FILE}"
)
SOURCE_OPTION = re.compile(
    r"sumo-net-file|(osm|opendrive|node|edge|connection|type|tllogic|polygon|additional)-files"
)
"""Options that name files to read: all such options of netconvert, and those of SUMO except the
network and its traffic.
"""
MESSAGE_LENGTH = 500
"""Number of characters of a program's message that are used."""


class ElementChange(NamedTuple):
    """A change of the elements at a path of an XML file: pairs of an attribute and its new value,
    or None if the elements are removed. It is an item of `XmlChanges`, but can be hashed.
    """

    path: str
    attributes: tuple[tuple[str, str], ...] | None


class NetworkFiles(NamedTuple):
    """A network, with the digests of its files when it was opened.

    `roads_file` is the built network, or the recipe from which netconvert builds it. `digests` are
    pairs of a file's name and its digest: of the recipe and its sources (without a recipe, of the
    built network), of the traffic, of SUMO's options, and of files that these options name.
    `lane_changes` and `traffic_changes` are changes by a scenario's parameters, of lanes of the
    built network and of the traffic.
    """

    folder: Path
    roads_file: str
    digests: tuple[tuple[str, str], ...]
    lane_changes: tuple[ElementChange, ...] = ()
    traffic_changes: tuple[ElementChange, ...] = ()

    def path(self, name: str) -> Path:
        return self.folder / name

    @property
    def is_built(self) -> bool:
        """Whether a file has the built network; otherwise netconvert builds it from a recipe."""
        return self.roads_file.endswith(NETWORK_ENDING)


def open_network(network: str) -> NetworkFiles:
    """A network, given by its name in `sumo_nets/`, by its folder, or by a `.net.xml` file beside
    its traffic.

    Raises
    ------
    InputError
        If the network does not exist, a file is missing, or it is unclear which files to use.
    """
    path = NETWORKS / network if is_shipped(network) else Path(network)
    if not is_network(path):
        names = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
        raise InputError(
            "",
            f"there is no network {network!r}{did_you_mean(network, names)}",
            f"one of {', '.join(names)}, or {LEGAL_FOLDERS}",
        )
    folder = path.parent
    roads_file = path.name
    if path.is_dir():
        folder = path
        roads_file = _roads_in(path)

    names = [roads_file, *_sources_of(folder / roads_file), TRAFFIC_FILE, OPTIONS_FILE]
    if (folder / OPTIONS_FILE).is_file():
        names += _sources_of(folder / OPTIONS_FILE)
    for name in names:
        if not (folder / name).is_file():
            raise InputError(folder, f"{name} is missing", LEGAL_FOLDERS)
    digests = tuple((name, _digest((folder / name).read_bytes())) for name in names)
    if is_shipped(network):
        roads_file = NETWORK_FILE
    return NetworkFiles(folder, roads_file, digests)


def is_shipped(network: str) -> bool:
    """Whether a network is given by its name in `sumo_nets/`."""
    return (
        network not in ("", ".", "..")
        and Path(network).name == network
        and is_network(NETWORKS / network)
    )


def is_network(path: Path) -> bool:
    """Whether a path is a folder or a built network."""
    try:
        return path.is_dir() or (path.name.endswith(NETWORK_ENDING) and path.is_file())
    # The operating system refuses some names, such as a name that is too long.
    except OSError:
        return False


def options_in(file: Path) -> dict[str, str]:
    """The options that a configuration of SUMO or netconvert sets."""
    return {
        element.tag: element.attrib["value"].strip()
        for element in parse_xml(file).iter()
        if "value" in element.attrib
    }


def _roads_in(folder: Path) -> str:
    """The recipe in a folder or, without a recipe, its built network. If there are several, SUMO's
    option `net-file` decides.
    """
    names = _names_in(folder, RECIPE_ENDING) or _names_in(folder, NETWORK_ENDING)
    if len(names) > 1 and (folder / OPTIONS_FILE).is_file():
        network_option = options_in(folder / OPTIONS_FILE).get("net-file")
        if network_option in names:
            names = [network_option]
    if len(names) != 1:
        raise InputError(
            folder,
            f"has {' and '.join(names) or 'no network'}",
            f"{LEGAL_FOLDERS}; of several networks, net-file in {OPTIONS_FILE} names one",
        )
    return names[0]


def _names_in(folder: Path, ending: str) -> list[str]:
    return sorted(file.name for file in folder.glob(f"*{ending}"))


def _sources_of(file: Path) -> list[str]:
    """The names of the files that a configuration reads; none for a built network."""
    if file.name.endswith(NETWORK_ENDING):
        return []
    names = list[str]()
    for option, value in options_in(file).items():
        if SOURCE_OPTION.fullmatch(option):
            names += (name.strip() for name in value.split(","))
    return names


class CopiedNetwork(NamedTuple):
    """The files of a simulation: the copies of the network, the copies of the traffic, and SUMO's
    options.
    """

    network: Path
    traffic: Path
    options: Path


def copied_network(network: NetworkFiles, n: int) -> CopiedNetwork:
    """Make at least `n` copies of a network, and traffic for `n` of these copies.

    Raises
    ------
    InputError
        If a source is not XML, netconvert refuses the sources or is not installed, or an element
        cannot be copied.
    EnvironmentFault
        If netconvert fails for another reason, or the cache cannot be written.
    """
    # Few sizes of networks serve all batches: 1, 2, 5, 10, 20, 50, ... The power of ten has as many
    # digits as n.
    power = 10 ** (len(str(n)) - 1)
    size = min(factor * power for factor in (1, 2, 5, 10) if factor * power >= n)
    traffic_file = network.path(TRAFFIC_FILE)

    def copy_roads(into: Path) -> None:
        with about(
            network.path(network.roads_file) if network.is_built else network.folder
        ):
            write_roads(parse_xml(built_network(network)), size, into / NETWORK_FILE)

    def copy_traffic(into: Path) -> None:
        with about(traffic_file):
            write_demand(
                [_changed(traffic_file, network.traffic_changes)],
                n,
                into / TRAFFIC_FILE,
            )

    roads = cache_folder_name(network, size, road_digests(network))
    traffic = cache_folder_name(
        network, n, [dict(network.digests)[TRAFFIC_FILE], repr(network.traffic_changes)]
    )
    return CopiedNetwork(
        ensure_cached(roads, NETWORK_FILE, copy_roads),
        ensure_cached(traffic, TRAFFIC_FILE, copy_traffic),
        network.path(OPTIONS_FILE),
    )


@contextmanager
def varied_network(networks: Sequence[NetworkFiles], n: int) -> Iterator[CopiedNetwork]:
    """`n` copies of a network. Either `networks` is this network alone, or it has a network for
    each copy, and they differ only in their traffic; then the file with the traffic exists until
    the context ends. Raises the errors of `copied_network`.
    """
    files = copied_network(networks[0], n)
    if len(networks) == 1:
        yield files
        return
    traffic_file = networks[0].path(TRAFFIC_FILE)
    with temporary_folder() as folder:
        file = Path(folder, TRAFFIC_FILE)
        roots = [
            _changed(traffic_file, network.traffic_changes) for network in networks
        ]
        with about(traffic_file):
            write_demand(roots, n, file)
        yield files._replace(traffic=file)


def built_network(network: NetworkFiles) -> Path:
    """The file of the built network with its changes of lanes. netconvert builds the network if
    this has not been done yet. Raises the errors of `copied_network`.
    """
    if not network.lane_changes and network.is_built:
        return network.path(network.roads_file)
    original = network._replace(lane_changes=(), traffic_changes=())

    def build(into: Path) -> None:
        if network.lane_changes:
            content = ElementTree.tostring(
                _changed(built_network(original), network.lane_changes)
            )
            (into / NETWORK_FILE).write_bytes(content)
        else:
            _run_netconvert(network, into / NETWORK_FILE)

    return ensure_cached(
        cache_folder_name(network, 0, road_digests(network)), NETWORK_FILE, build
    )


@cache
def number_of_lanes(network: NetworkFiles) -> int:
    """Number of lanes of a network, junctions included; raises the errors of `copied_network`."""
    return built_network(network).read_bytes().count(b"<lane ")


@cache
def sumo_version() -> str:
    return version("libsumo")


def cache_folder_name(network: NetworkFiles, n: int, digests: Sequence[str]) -> str:
    """Name of the folder in the cache for `n` copies of a network whose files have these
    digests.
    """
    # SUMO splits file names at commas.
    name = re.sub(r"[^a-zA-Z0-9_.-]", "_", network.folder.name)
    content = " ".join([*digests, sumo_version(), _code_digest()])
    return f"{name}-{n}-{_digest(content.encode())}"


def program_of_sumo(name: str, source: object) -> str:
    """The path of a program of SUMO, which a source needs.

    Raises
    ------
    InputError
        If the extra `sumo` is not installed.
    """
    try:
        import sumo
    except ImportError:
        raise missing_extra(source, f"needs SUMO's program {name}", "sumo") from None
    return str(Path(sumo.SUMO_HOME) / "bin" / name)


def run_program(folder: Path, *command: str) -> tuple[int, str]:
    """Run a program of SUMO in a folder. Returns the exit code, and the program's errors and
    warnings on one line.
    """
    process = subprocess.run(
        [*command, "--xml-validation", "never"],
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
        cwd=folder,
    )
    lines = [
        line.strip()
        for line in process.stderr.splitlines()
        if line.strip() and not line.startswith("Quitting")
    ]
    return process.returncode, " ".join(lines).removeprefix("Error: ")[:MESSAGE_LENGTH]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:DIGEST_LENGTH]


@cache
def _code_digest() -> str:
    return _digest(
        Path(__file__).read_bytes() + Path(str(copies.__file__)).read_bytes()
    )


def road_digests(network: NetworkFiles) -> list[str]:
    """Texts that identify a network's roads: digests of its sources and of the built network, and
    the changes of lanes.
    """
    digests = []
    for name, digest in network.digests:
        if name not in (TRAFFIC_FILE, OPTIONS_FILE):
            digests.append(digest)
    if network.is_built:
        digests.append(_digest(network.path(network.roads_file).read_bytes()))
    return [*digests, repr(network.lane_changes)]


def _run_netconvert(network: NetworkFiles, file: Path) -> None:
    """Build a network from its recipe. An error of the machine, such as no memory or no place on
    the disk, is an EnvironmentFault; any other error is an error of the recipe.
    """
    netconvert = program_of_sumo("netconvert", network.path(network.roads_file))
    arguments = ("-c", network.roads_file, "-o", str(file), "--no-warnings", "true")
    exit_code, errors = run_program(network.folder, netconvert, *arguments)
    if (
        exit_code < 0
        or "bad_alloc" in errors
        or ("Could not" in errors and "output" in errors)
    ):
        raise EnvironmentFault(
            f"{network.folder}: netconvert fails: {errors or f'exit code {exit_code}'}"
        )
    if exit_code != 0:
        raise InputError(
            network.folder,
            f"netconvert refuses the network: {errors}",
            "sources that netconvert builds a network from",
        )


def network_for(scenario: Scenario) -> NetworkFiles:
    """The network of a scenario, with the changes of lanes and traffic by its parameters.

    Raises
    ------
    InputError
        If the parameters are impossible, or change an element that the network or the traffic file
        lacks.
    EnvironmentFault
        If the cache cannot be written.
    """
    return networks_for([scenario])[0]


def networks_for(scenarios: Sequence[Scenario]) -> list[NetworkFiles]:
    """The networks of several scenarios, as of `network_for`. The files of a network that several
    scenarios share are read only once. Raises the errors of `network_for`.
    """
    opened = {}
    networks = []
    for scenario in scenarios:
        if scenario.network not in opened:
            opened[scenario.network] = open_network(scenario.network)
        network = opened[scenario.network]
        lanes = _frozen(scenario.lanes(_BuiltRoads(network)))
        network = network._replace(lane_changes=lanes)
        actors = _frozen(scenario.actors(_BuiltRoads(network)))
        networks.append(network._replace(traffic_changes=actors))
    return networks


def _frozen(changes: XmlChanges) -> tuple[ElementChange, ...]:
    """The changes as records, which can be hashed."""
    records = []
    for path, attributes in changes.items():
        pairs = None if attributes is None else tuple(attributes.items())
        records.append(ElementChange(path, pairs))
    return tuple(records)


class _BuiltRoads:
    """The lanes of a built network."""

    def __init__(self, network: NetworkFiles) -> None:
        self._network = network

    def lane(self, lane: str) -> Lane:
        shapes = _lane_shapes(self._network)
        if lane not in shapes:
            raise InputError(self._network.folder, f"there is no lane {lane!r}")
        points = (point.split(",") for point in shapes[lane].split())
        return lane_through(lane, [(float(x), float(y)) for x, y, *_ in points])


@lru_cache(maxsize=100)
def _lane_shapes(network: NetworkFiles) -> dict[str, str]:
    return {
        lane.attrib["id"]: lane.attrib["shape"]
        for lane in parse_xml(built_network(network)).iter("lane")
    }


def _changed(file: Path, changes: Iterable[ElementChange]) -> ElementTree.Element:
    """The root of an XML file with these changes. A path without an element is an error."""
    root = parse_xml(file)
    for path, attributes in changes:
        elements = root.findall(path)
        if not elements:
            raise InputError(file, f"has no {path}")
        for element in elements:
            if attributes is None:
                root.remove(element)
            else:
                element.attrib.update(attributes)
    return root
