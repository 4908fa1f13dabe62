"""The files and options of a network's folder: no option may write files, open sockets, use random numbers or read other folders."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import InputError, did_you_mean
from safevar_sumo.shipped import NETWORKS

SECTIONS = frozenset({
    "configuration", "input", "time", "processing", "report", "gui_only", "random_number", "routing", "output", "projection",
    "building_defaults", "tls_building", "ramp_guessing", "edge_removal", "unregulated_nodes", "junctions", "pedestrian", "bicycle",
    "railway", "formats"})
SIMULATING = re.compile(
    r"net-file|route-files|gui-settings-file|begin|step-length|step-method\.ballistic|lateral-resolution|seed|max-depart-delay"
    r"|(collision|intermodal-collision|pedestrian|default|time-to-teleport|emergencydecel)(\.[a-z-]+)+|time-to-teleport"
    r"|ignore-junction-blocker|ignore-accidents|no-internal-links|lanechange\.duration|no-warnings|no-step-log|verbose")
"""Legal options of SUMO: how vehicles and persons move, or which of the folder's files SUMO reads."""
BUILDING = re.compile(
    r"precision|simple-projection|proj\.(scale|rotate|utm|dhdn|inverse|dhdnutm)|speed-in-kmh|flatten|lefthand|flip-y-axis|join-lanes"
    r"|max-join-ids|dismiss-vclasses|construction-date|numerical-ids|plain\.extend-edge-shape|no-internal-links|no-left-connections"
    r"|no-turnarounds(\.[a-z]+)?|rectangular-lane-cut|ignore-widths|ignore-change-restrictions|discard-params|ignore-errors(\.[a-z-]+)?"
    r"|keep-nodes-unregulated(\.[a-z-]+)?|walkingareas|(geometry|offset|roundabouts|opposites|fringe|speed|edges|default|tls|ramps"
    r"|keep-edges|remove-edges|keep-lanes|junctions|internal-junctions|check-lane-foes|sidewalks|crossings|walkingareas|bikelanes"
    r"|railway|osm|opendrive)(\.[a-zA-Z-]+)+(?<!file)(?<!output)")
"""Legal options of netconvert: how it builds the network from the sources."""
SOURCES = ("sumo-net-file", "osm-files", "opendrive-files", "node-files", "edge-files", "connection-files", "type-files",
           "tllogic-files", "polygon-files")
"""Options of netconvert with names of source files."""
IGNORED = re.compile(r"output-file|verbose|print-options|no-warnings|aggregate-warnings|xml-validation(\.net)?|write-license|write-metadata"
                     r"|log\.(timestamps|processid)|human-readable-time")
"""Options of netconvert that do not affect the network and are ignored; the output file is set by this tool."""
TRAFFIC = "traffic.rou.xml"


def options_of(file: Path) -> dict[str, str]:
    """The options that a configuration of SUMO or netconvert sets.

    Raises
    ------
    InputError
        If the file is no such configuration, or sets an option twice.
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
        elif element is not root and element.tag not in SECTIONS:
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
        if not SIMULATING.fullmatch(name):
            raise InputError(file, f"sets SUMO's option {name!r}", "options that write no file, open no socket and draw nothing at random, "
                             "such as step-length, collision.* and pedestrian.*")
    for name in ("net-file", "gui-settings-file"):
        own_files(file, name, options.get(name, ""))
    if options.get("route-files", TRAFFIC) != TRAFFIC:
        raise InputError(file, f"route-files = {options['route-files']!r}", f"{TRAFFIC}, all traffic in one file")


def recipe_of(file: Path) -> tuple[dict[str, tuple[str, ...]], dict[str, str], str]:
    """Source files by netconvert's option, the options that shape the network, and the name of the network that the recipe writes.

    Raises
    ------
    InputError
        Naming the file and the illegal option.
    """
    sources, options = dict[str, tuple[str, ...]](), dict[str, str]()
    configured = options_of(file)
    for name, value in configured.items():
        if name in SOURCES:
            sources[name] = own_files(file, name, value)
        elif BUILDING.fullmatch(name):
            options[name] = value
        elif not IGNORED.fullmatch(name):
            raise InputError(file, f"sets netconvert's option {name!r}", f"options that shape the network, such as junctions.*, tls.* and "
                             f"no-turnarounds, and its sources: {', '.join(SOURCES)}")
    return sources, options, configured.get("output-file", "")


def own_files(file: Path, name: str, value: str) -> tuple[str, ...]:
    """The files named by an option, which are in the folder of the configuration.

    Raises
    ------
    InputError
        If a file is in another folder or missing.
    """
    files = tuple(part.strip() for part in value.split(",") if part.strip())
    for named in files:
        if Path(named).name != named or "\\" in named:
            raise InputError(file, f"{name} = {named!r} is in another folder", "the name of a file in the same folder")
        if name in SOURCES and not (file.parent / named).is_file():
            raise InputError(file, f"{name}: {named} is missing", "a file in the same folder")
    return files


OPTIONS = "scenario.sumocfg"
BUILT = ".net.xml"
PLAIN = {"node-files": "nod", "edge-files": "edg", "connection-files": "con", "type-files": "typ", "tllogic-files": "tll"}
"""Endings of the files of netconvert's options."""
REQUIRED = ("network.nod.xml", "network.edg.xml", "network.con.xml", TRAFFIC, OPTIONS)
LEGAL = f"a folder with {', '.join(REQUIRED)}; or with a {BUILT}, {TRAFFIC} and {OPTIONS}"
PRECISION = {"precision": "4"}
"""Digits of coordinates unless a recipe sets them."""


class Sources(NamedTuple):
    """A network's folder, and the files in it that are used.

    Either `built` names the network, or netconvert builds it with `options` from `plain`, files by netconvert's options;
    `recipe` names the file with these options, and `builds` the network that it writes.
    """

    place: Path
    built: str = ""
    plain: tuple[tuple[str, tuple[str, ...]], ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    recipe: str = ""
    builds: str = ""

    @property
    def roads(self) -> tuple[str, ...]:
        """The source files of the network itself."""
        named = (self.built, *(name for _, names in self.plain for name in names), self.recipe)
        return tuple(name for name in named if name)

    @property
    def files(self) -> tuple[str, ...]:
        """All files that are used."""
        return (*self.roads, TRAFFIC, OPTIONS)

    def contents(self, *names: str) -> tuple[bytes, ...]:
        """Contents of some of the files."""
        return tuple((self.place / name).read_bytes() for name in names)


def sources_of(network: str) -> Sources:
    """The sources of a network of `sumo_nets/`, of a folder, or of a `.net.xml` beside its traffic, by path.

    Raises
    ------
    InputError
        If there is no such network, a file is missing, or it is unclear which files to use.
    """
    place = NETWORKS / network if is_shipped(network) else Path(network)
    if is_network(place):
        sources = _in_folder(place, _listing(place)) if place.is_dir() else Sources(place.parent, built=place.name)
        if "," in str(sources.place.absolute()):
            raise InputError(sources.place, "has a comma in its path, at which SUMO splits file names", "a path without commas")
        for name in (TRAFFIC, OPTIONS):
            if not (sources.place / name).is_file():
                raise InputError(sources.place, f"{name} is missing", LEGAL)
        return sources
    names = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
    raise InputError("scenario.parameters.network", f"there is no network {network!r}{did_you_mean(network, names)}",
                     f"one of {', '.join(names)}, a folder, or a {BUILT} beside {TRAFFIC} and {OPTIONS}")


def is_shipped(network: str) -> bool:
    """Whether this is the name of a network in `sumo_nets/`."""
    return network not in ("", ".", "..") and Path(network).name == network and is_network(NETWORKS / network)


def is_network(place: Path) -> bool:
    """Whether a path may be that of a network: a folder or a built network."""
    try:
        return place.is_dir() or (place.name.endswith(BUILT) and place.is_file())
    except OSError:  # such as a name that is too long
        return False


def _listing(place: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, modification times and sizes of the files in a folder."""
    with os.scandir(place) as entries:
        return tuple(sorted((entry.name, entry.stat().st_mtime_ns, entry.stat().st_size) for entry in entries if entry.is_file()))


@lru_cache(maxsize=256)
def _in_folder(place: Path, listing: tuple[tuple[str, int, int], ...]) -> Sources:
    """The sources in a folder; read again when its `listing` changes."""
    plain, named = _plain(place), _named(place)
    if plain is not None and (not plain.builds or named in ("", plain.builds) or not (place / named).is_file()):
        sources = plain
    elif named and (place / named).is_file():
        sources = Sources(place, built=named)
    else:
        sources = Sources(place, built=_only(place))
    for ending in PLAIN.values():
        for file in sorted(place.glob(f"*.{ending}.xml")):
            if file.name not in sources.roads:
                reason = f"{sources.recipe} does not name it" if sources.recipe else f"the network is made of {', '.join(sources.roads)}"
                raise InputError(file, f"is not used: {reason}", "sources that a network.netccfg names; or a folder without unused files")
    return sources


def _plain(place: Path) -> Sources | None:
    """The plain sources, given by a recipe or by their names; None if there are none."""
    recipes = sorted(place.glob("*.netccfg"))
    if len(recipes) > 1:
        raise InputError(place, f"has {' and '.join(file.name for file in recipes)}", "one recipe")
    if recipes:
        (recipe,) = recipes
        sources, options, builds = recipe_of(recipe)
        if not sources:
            raise InputError(recipe, "names no sources", "node-files, edge-files and connection-files, or another network")
        return Sources(place, "", tuple(sources.items()), tuple(options.items()), recipe.name, builds)
    names = {option: f"network.{ending}.xml" for option, ending in PLAIN.items()}
    files = {option: (name,) for option, name in names.items() if (place / name).is_file()}
    if not files:
        return None
    for name in REQUIRED[:3]:
        if not (place / name).is_file():
            raise InputError(place, f"{name} is missing", LEGAL)
    return Sources(place, "", tuple(files.items()), tuple(PRECISION.items()), "", f"network{BUILT}")


def _named(place: Path) -> str:
    """The network that the folder's configuration names; "" if none."""
    return options_of(place / OPTIONS).get("net-file", "") if (place / OPTIONS).is_file() else ""


def _only(place: Path) -> str:
    """The one network that has been built in a folder without sources."""
    networks = sorted(file.name for file in place.glob(f"*{BUILT}"))
    if not networks:
        raise InputError(place, f"{REQUIRED[0]} is missing", LEGAL)
    if len(networks) > 1:
        raise InputError(place, f"has {' and '.join(networks)}", f"one network, or net-file in {OPTIONS} that names one")
    return networks[0]
