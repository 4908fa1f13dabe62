"""What a network is made of: a folder's plain-XML sources with their recipe, or a network that has been built already."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import InputError, did_you_mean
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.simulation.options import TRAFFIC, options_of, recipe_of

OPTIONS = "scenario.sumocfg"
BUILT = ".net.xml"
PLAIN = {"node-files": "nod", "edge-files": "edg", "connection-files": "con", "type-files": "typ", "tllogic-files": "tll"}
"""Netconvert's options and how their files are called."""
REQUIRED = ("network.nod.xml", "network.edg.xml", "network.con.xml", TRAFFIC, OPTIONS)
LEGAL = f"a folder with {', '.join(REQUIRED)}; or with a {BUILT}, {TRAFFIC} and {OPTIONS}"
PRECISION = {"precision": "4"}
"""Digits of coordinates, where no recipe says how many."""


class Sources(NamedTuple):
    """A network's folder, and which of its files count.

    Either `built` names the network, or netconvert builds it from `plain`, files by its options, as `options` say;
    `recipe` names the file that says so, and `builds` the network that it writes.
    """

    place: Path
    built: str = ""
    plain: tuple[tuple[str, tuple[str, ...]], ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    recipe: str = ""
    builds: str = ""

    @property
    def roads(self) -> tuple[str, ...]:
        """The files that the network itself is made of."""
        named = (self.built, *(name for _, names in self.plain for name in names), self.recipe)
        return tuple(name for name in named if name)

    @property
    def files(self) -> tuple[str, ...]:
        """All files that count."""
        return (*self.roads, TRAFFIC, OPTIONS)

    def contents(self, *names: str) -> tuple[bytes, ...]:
        """What is in some of its files."""
        return tuple((self.place / name).read_bytes() for name in names)


def sources_of(network: str) -> Sources:
    """The sources of a network of `sumo_nets/`, of a folder, or of a `.net.xml` beside its traffic, by path.

    Raises
    ------
    InputError
        If there is no such network, a file is missing, or it is not clear which files count.
    """
    place = NETWORKS / network if is_shipped(network) else Path(network)
    if is_network(place):
        sources = _in_folder(place, _listing(place)) if place.is_dir() else Sources(place.parent, built=place.name)
        if "," in str(sources.place.absolute()):
            raise InputError(sources.place, "has a comma in its path, where SUMO takes the next file to begin", "a folder without")
        for name in (TRAFFIC, OPTIONS):
            if not (sources.place / name).is_file():
                raise InputError(sources.place, f"{name} is missing", LEGAL)
        return sources
    names = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
    raise InputError("scenario.parameters.network", f"there is no network {network!r}{did_you_mean(network, names)}",
                     f"one of {', '.join(names)}, a folder, or a {BUILT} beside {TRAFFIC} and {OPTIONS}")


def is_shipped(network: str) -> bool:
    """Whether it is the name of one of `sumo_nets/`."""
    return network not in ("", ".", "..") and Path(network).name == network and is_network(NETWORKS / network)


def is_network(place: Path) -> bool:
    """Whether a path may be that of a network."""
    try:
        return place.is_dir() or (place.name.endswith(BUILT) and place.is_file())
    except OSError:  # a name that is too long, say
        return False


def _listing(place: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, times of change and sizes of what lies in a folder."""
    with os.scandir(place) as entries:
        return tuple(sorted((entry.name, entry.stat().st_mtime_ns, entry.stat().st_size) for entry in entries if entry.is_file()))


@lru_cache(maxsize=256)
def _in_folder(place: Path, listing: tuple[tuple[str, int, int], ...]) -> Sources:
    """The sources in a folder; looked at again when its `listing` changes."""
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
                what = f"{sources.recipe} does not name it" if sources.recipe else f"the network is made of {', '.join(sources.roads)}"
                raise InputError(file, f"is not used: {what}", "every source used, named by a network.netccfg; or no file that is not")
    return sources


def _plain(place: Path) -> Sources | None:
    """The plain sources, as a recipe or their names have it."""
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
    found = {option: (name,) for option, name in names.items() if (place / name).is_file()}
    if not found:
        return None
    for name in REQUIRED[:3]:
        if not (place / name).is_file():
            raise InputError(place, f"{name} is missing", LEGAL)
    return Sources(place, "", tuple(found.items()), tuple(PRECISION.items()), "", f"network{BUILT}")


def _named(place: Path) -> str:
    """The network that the folder's configuration names."""
    return options_of(place / OPTIONS).get("net-file", "") if (place / OPTIONS).is_file() else ""


def _only(place: Path) -> str:
    """The one network that has been built in a folder without sources."""
    found = sorted(file.name for file in place.glob(f"*{BUILT}"))
    if not found:
        raise InputError(place, f"{REQUIRED[0]} is missing", LEGAL)
    if len(found) > 1:
        raise InputError(place, f"has {' and '.join(found)}", f"one network, or net-file in {OPTIONS} that says which")
    return found[0]
