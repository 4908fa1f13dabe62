"""Files and options in a network's folder. Options must not write files, open sockets, use random numbers or read other folders."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import InputError, did_you_mean
from safevar_sumo.shipped import NETWORKS

CONFIGURATION_SECTIONS = frozenset({
    "configuration", "input", "time", "processing", "report", "gui_only", "random_number", "routing", "output", "projection",
    "building_defaults", "tls_building", "ramp_guessing", "edge_removal", "unregulated_nodes", "junctions", "pedestrian", "bicycle",
    "railway", "formats"})
SUMO_OPTIONS = re.compile(
    r"net-file|route-files|gui-settings-file|begin|step-length|step-method\.ballistic|lateral-resolution|seed|max-depart-delay"
    r"|(collision|intermodal-collision|pedestrian|default|time-to-teleport|emergencydecel)(\.[a-z-]+)+|time-to-teleport"
    r"|ignore-junction-blocker|ignore-accidents|no-internal-links|lanechange\.duration|no-warnings|no-step-log|verbose")
"""Legal options of SUMO: they determine how vehicles and persons move, or which files of the folder SUMO reads."""
NETCONVERT_OPTIONS = re.compile(
    r"precision|simple-projection|proj\.(scale|rotate|utm|dhdn|inverse|dhdnutm)|speed-in-kmh|flatten|lefthand|flip-y-axis|join-lanes"
    r"|max-join-ids|dismiss-vclasses|construction-date|numerical-ids|plain\.extend-edge-shape|no-internal-links|no-left-connections"
    r"|no-turnarounds(\.[a-z]+)?|rectangular-lane-cut|ignore-widths|ignore-change-restrictions|discard-params|ignore-errors(\.[a-z-]+)?"
    r"|keep-nodes-unregulated(\.[a-z-]+)?|walkingareas|(geometry|offset|roundabouts|opposites|fringe|speed|edges|default|tls|ramps"
    r"|keep-edges|remove-edges|keep-lanes|junctions|internal-junctions|check-lane-foes|sidewalks|crossings|walkingareas|bikelanes"
    r"|railway|osm|opendrive)(\.[a-zA-Z-]+)+(?<!file)(?<!output)")
"""Legal options of netconvert: they determine how netconvert builds the network from the sources."""
SOURCE_OPTIONS = ("sumo-net-file", "osm-files", "opendrive-files", "node-files", "edge-files", "connection-files", "type-files",
           "tllogic-files", "polygon-files")
"""Options of netconvert that name source files."""
IGNORED_OPTIONS = re.compile(r"output-file|verbose|print-options|no-warnings|aggregate-warnings|xml-validation(\.net)?|write-license"
                             r"|write-metadata|log\.(timestamps|processid)|human-readable-time")
"""Options of netconvert that are ignored, because they do not affect the network; safevar sets the output file."""
TRAFFIC_FILE = "traffic.rou.xml"


def options_of(file: Path) -> dict[str, str]:
    """The options that a configuration of SUMO or netconvert sets.

    Raises
    ------
    InputError
        If the file is no configuration of SUMO or netconvert, or sets an option twice.
    """
    try:
        root = ElementTree.fromstring(file.read_bytes())
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(file, f"cannot be read: {error}", "a configuration of SUMO") from None
    options: dict[str, str] = {}
    for element in root.iter():
        if "value" in element.attrib and element is not root:
            if element.tag in options:
                raise InputError(file, f"sets {element.tag!r} twice", "each option once")
            options[element.tag] = element.attrib["value"].strip()
        elif element is not root and element.tag not in CONFIGURATION_SECTIONS:
            raise InputError(file, f"sets SUMO's option {element.tag!r} without value=", f'<{element.tag} value="..."/>')
    return options


def check_options(file: Path) -> None:
    """Refuse a configuration of SUMO with an illegal option.

    Raises
    ------
    InputError
        Naming the file and the option.
    """
    options = options_of(file)
    for name in options:
        if not SUMO_OPTIONS.fullmatch(name):
            raise InputError(file, f"sets SUMO's option {name!r}", "options that write no file, open no socket and draw nothing at random, "
                             "such as step-length, collision.* and pedestrian.*")
    for name in ("net-file", "gui-settings-file"):
        local_files(file, name, options.get(name, ""))
    if options.get("route-files", TRAFFIC_FILE) != TRAFFIC_FILE:
        raise InputError(file, f"route-files = {options['route-files']!r}", f"{TRAFFIC_FILE}, all traffic in one file")


def recipe_of(file: Path) -> tuple[dict[str, tuple[str, ...]], dict[str, str], str]:
    """Read a recipe: source files by option of netconvert, options that shape the network, and the name of the network to write.

    Raises
    ------
    InputError
        Naming the file and the illegal option.
    """
    files_by_option, options = dict[str, tuple[str, ...]](), dict[str, str]()
    recipe = options_of(file)
    for name, value in recipe.items():
        if name in SOURCE_OPTIONS:
            files_by_option[name] = local_files(file, name, value)
        elif NETCONVERT_OPTIONS.fullmatch(name):
            options[name] = value
        elif not IGNORED_OPTIONS.fullmatch(name):
            raise InputError(file, f"sets netconvert's option {name!r}", f"options that shape the network, such as junctions.*, tls.* and "
                             f"no-turnarounds, and its sources: {', '.join(SOURCE_OPTIONS)}")
    return files_by_option, options, recipe.get("output-file", "")


def local_files(file: Path, option: str, value: str) -> tuple[str, ...]:
    """The files that an option names; they must be in the folder of the configuration.

    Raises
    ------
    InputError
        If a file is in another folder or missing.
    """
    files = tuple(part.strip() for part in value.split(",") if part.strip())
    for file_name in files:
        if Path(file_name).name != file_name or "\\" in file_name:
            raise InputError(file, f"{option} = {file_name!r} is in another folder", "the name of a file in the same folder")
        if option in SOURCE_OPTIONS and not (file.parent / file_name).is_file():
            raise InputError(file, f"{option}: {file_name} is missing", "a file in the same folder")
    return files


OPTIONS_FILE = "scenario.sumocfg"
NETWORK_ENDING = ".net.xml"
PLAIN_ENDINGS = {"node-files": "nod", "edge-files": "edg", "connection-files": "con", "type-files": "typ", "tllogic-files": "tll"}
"""Options of netconvert, with the endings of their source files."""
REQUIRED_FILES = ("network.nod.xml", "network.edg.xml", "network.con.xml", TRAFFIC_FILE, OPTIONS_FILE)
LEGAL_FOLDERS = f"a folder with {', '.join(REQUIRED_FILES)}; or with a {NETWORK_ENDING}, {TRAFFIC_FILE} and {OPTIONS_FILE}"
DEFAULT_OPTIONS = {"precision": "4"}
"""Options of netconvert for a folder without a recipe: decimal digits of coordinates."""


class Sources(NamedTuple):
    """A network's folder, and the names of the files in it that are used.

    Either `network_file` is the network, or netconvert builds the network with `options` from `plain_files`, which are given by option;
    the file `recipe` contains these options, and `output_file` is the network that the recipe writes.
    """

    folder: Path
    network_file: str = ""
    plain_files: tuple[tuple[str, tuple[str, ...]], ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    recipe: str = ""
    output_file: str = ""

    @property
    def road_files(self) -> tuple[str, ...]:
        """The source files of the network without its traffic."""
        names = (self.network_file, *(name for _, option_names in self.plain_files for name in option_names), self.recipe)
        return tuple(name for name in names if name)

    @property
    def files(self) -> tuple[str, ...]:
        """Road files, traffic and SUMO's options."""
        return (*self.road_files, TRAFFIC_FILE, OPTIONS_FILE)

    def contents(self, *names: str) -> tuple[bytes, ...]:
        return tuple((self.folder / name).read_bytes() for name in names)


NETWORK_KEY = "scenario.parameters.network"
"""Key of a study that names the network, the source of errors about a network that does not exist."""


def sources_of(network: str) -> Sources:
    """The sources of a network, given by its name in `sumo_nets/`, by its folder, or by a `.net.xml` file beside its traffic.

    Raises
    ------
    InputError
        If the network does not exist, a file is missing, or it is unclear which files to use.
    """
    path = NETWORKS / network if is_shipped(network) else Path(network)
    if is_network(path):
        sources = _folder_sources(path, _list_files(path)) if path.is_dir() else Sources(path.parent, network_file=path.name)
        if "," in str(sources.folder.absolute()):
            raise InputError(sources.folder, "has a comma in its path, at which SUMO splits file names", "a path without commas")
        for name in (TRAFFIC_FILE, OPTIONS_FILE):
            if not (sources.folder / name).is_file():
                raise InputError(sources.folder, f"{name} is missing", LEGAL_FOLDERS)
        return sources
    names = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
    raise InputError(NETWORK_KEY, f"there is no network {network!r}{did_you_mean(network, names)}",
                     f"one of {', '.join(names)}, a folder, or a {NETWORK_ENDING} beside {TRAFFIC_FILE} and {OPTIONS_FILE}")


def is_shipped(network: str) -> bool:
    """Whether a network is given by its name in `sumo_nets/`."""
    return network not in ("", ".", "..") and Path(network).name == network and is_network(NETWORKS / network)


def is_network(path: Path) -> bool:
    """Whether a path is a folder or a built network."""
    try:
        return path.is_dir() or (path.name.endswith(NETWORK_ENDING) and path.is_file())
    except OSError:  # for example, a name is too long
        return False


def _list_files(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, modification times and sizes of the files in a folder."""
    with os.scandir(folder) as entries:
        return tuple(sorted((entry.name, entry.stat().st_mtime_ns, entry.stat().st_size) for entry in entries if entry.is_file()))


@lru_cache(maxsize=256)
def _folder_sources(folder: Path, listing: tuple[tuple[str, int, int], ...]) -> Sources:
    """The sources in a folder; they are read again when the folder's `listing` changes."""
    plain, network_file = _plain_sources(folder), _configured_network(folder)
    if plain is not None and (not plain.output_file or network_file in ("", plain.output_file) or not (folder / network_file).is_file()):
        sources = plain
    elif network_file and (folder / network_file).is_file():
        sources = Sources(folder, network_file=network_file)
    else:
        sources = Sources(folder, network_file=_only_network(folder))
    names = sources.road_files
    for ending in PLAIN_ENDINGS.values():
        for file in sorted(folder.glob(f"*.{ending}.xml")):
            if file.name not in names:
                reason = f"{sources.recipe} does not name it" if sources.recipe else f"the network is made of {', '.join(names)}"
                raise InputError(file, f"is not used: {reason}", "sources that a network.netccfg names; or a folder without unused files")
    return sources


def _plain_sources(folder: Path) -> Sources | None:
    """The plain sources in a folder, given by a recipe or by their file names; None if the folder has no plain sources."""
    recipes = sorted(folder.glob("*.netccfg"))
    if len(recipes) > 1:
        raise InputError(folder, f"has {' and '.join(file.name for file in recipes)}", "one .netccfg file")
    if recipes:
        (recipe,) = recipes
        files, options, output = recipe_of(recipe)
        if not files:
            raise InputError(recipe, "names no sources", "node-files, edge-files and connection-files, or another network")
        return Sources(folder, plain_files=tuple(files.items()), options=tuple(options.items()), recipe=recipe.name, output_file=output)
    names = {option: f"network.{ending}.xml" for option, ending in PLAIN_ENDINGS.items()}
    files = {option: (name,) for option, name in names.items() if (folder / name).is_file()}
    if not files:
        return None
    for name in REQUIRED_FILES[:3]:  # the plain sources
        if not (folder / name).is_file():
            raise InputError(folder, f"{name} is missing", LEGAL_FOLDERS)
    return Sources(folder, plain_files=tuple(files.items()), options=tuple(DEFAULT_OPTIONS.items()), output_file=f"network{NETWORK_ENDING}")


def _configured_network(folder: Path) -> str:
    """The network that the folder's configuration of SUMO names; "" if it names no network."""
    return options_of(folder / OPTIONS_FILE).get("net-file", "") if (folder / OPTIONS_FILE).is_file() else ""


def _only_network(folder: Path) -> str:
    """The only built network in a folder without sources."""
    networks = sorted(file.name for file in folder.glob(f"*{NETWORK_ENDING}"))
    if not networks:
        raise InputError(folder, f"{REQUIRED_FILES[0]} is missing", LEGAL_FOLDERS)
    if len(networks) > 1:
        raise InputError(folder, f"has {' and '.join(networks)}", f"one network, or net-file in {OPTIONS_FILE} that names one")
    return networks[0]
