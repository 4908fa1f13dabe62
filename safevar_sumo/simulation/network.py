"""N copies of a SUMO network and its traffic: same coordinates, no connection between them.

They are built from the folder's plain-XML sources by netconvert, once, and kept in the user's cache
folder by the content that they are made of.
"""

from __future__ import annotations

import hashlib
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import EnvironmentFault, InputError
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.simulation.cache import cached

SOURCES = ("network.nod.xml", "network.edg.xml", "network.con.xml")
TRAFFIC = "traffic.rou.xml"
ROADS = "network.net.xml"
NOBODY = "nobody.rou.xml"
OPTIONS = "scenario.sumocfg"
RECIPE = ("--precision", "4", "--xml-validation", "never")
"""Options of netconvert."""

# Attributes that hold ids, by element; an attribute may hold several, separated by spaces.
_IDS = {
    "node": ("id",), "edge": ("id", "from", "to"), "connection": ("from", "to"), "crossing": ("node", "edges"),
    "walkingArea": ("node", "edges"), "vType": ("id",), "person": ("id", "type"), "walk": ("edges", "from", "to"),
    "vehicle": ("id", "type", "route"), "route": ("id", "edges"), "stop": ("lane", "edge"),
    "trip": ("id", "type", "from", "to", "via"), "flow": ("id", "type", "route", "from", "to", "via"),
}


class CopiedNetwork(NamedTuple):
    """Files of N copies, and the options that SUMO runs them with."""

    network: Path
    traffic: Path
    options: Path


def copied_id(copy: int, name: str) -> str:
    """Id of `name` in a copy; internal edges keep their colon in front."""
    return f":{copy}.{name[1:]}" if name.startswith(":") else f"{copy}.{name}"


def copy_and_name(copied: str) -> tuple[int, str]:
    """The copy that an id belongs to and what it is called in the original: the inverse of `copied_id`."""
    colon = ":" if copied.startswith(":") else ""
    copy, _, name = copied.removeprefix(":").partition(".")
    return int(copy), colon + name


def copied_network(folder: str, n: int, *others: str) -> CopiedNetwork:
    """At least `n` copies of a network of `sumo_nets/` (or of a folder given by path) with traffic in `n` of them.

    With `others`, folders that differ from it in the traffic alone, the next `n` copies have the traffic of the next of them.

    Raises
    ------
    InputError
        If the folder or one of its sources is missing or is not XML.
    EnvironmentFault
        If netconvert refuses the sources or the cache cannot be written.
    """
    places = [folder_of(one) for one in (folder, *others)]
    place = places[0]
    roads = _cached(place, round_up(n * len(places)), [place / source for source in SOURCES], ROADS, _build_network)
    traffic = _cached(place, n, [one / TRAFFIC for one in places], TRAFFIC, partial(_write_traffic, places))
    return CopiedNetwork(roads, traffic, place / OPTIONS)


def empty_network(folder: str, n: int) -> CopiedNetwork:
    """The same copies with the types and routes of the traffic in `n` of them, and nobody there; raises as `copied_network`."""
    files, place = copied_network(folder, n), folder_of(folder)
    return files._replace(traffic=_cached(place, n, [place / TRAFFIC], NOBODY, _write_nobody))


def network_fingerprint(folder: str) -> str:
    """Tells networks of different content apart: sources, traffic and options."""
    return ":".join(network_files(folder).values())


def network_files(folder: str) -> dict[str, str]:
    """A digest of every file that a network is made of, by name."""
    place = folder_of(folder)
    return {name: hashlib.sha256((place / name).read_bytes()).hexdigest()[:16] for name in (*SOURCES, TRAFFIC, OPTIONS)}


def empty_fingerprint(folder: str) -> str:
    """Tells networks apart by everything but who is on them: sources, options, types and routes."""
    place = folder_of(folder)
    types = ElementTree.tostring(_nobody(parsed(place / TRAFFIC)))
    return _digest((types, *((place / name).read_bytes() for name in (*SOURCES, OPTIONS))), 0)


def netconvert_version() -> str:
    """Version of the SUMO that builds and simulates."""
    from importlib.metadata import version

    return version("eclipse-sumo")


def folder_of(folder: str) -> Path:
    """A network's folder; raises as `copied_network`."""
    for place in (NETWORKS / folder, Path(folder)):
        if is_folder(place):
            for name in (*SOURCES, TRAFFIC, OPTIONS):
                if not (place / name).is_file():
                    raise InputError(place, f"{name} is missing", f"a folder with {', '.join((*SOURCES, TRAFFIC, OPTIONS))}")
            return place
    names = sorted(path.name for path in NETWORKS.iterdir() if path.is_dir())
    raise InputError("scenario.parameters.network", f"there is no network {folder!r}", f"one of {', '.join(names)}, or a folder")


def is_folder(place: Path) -> bool:
    try:
        return place.is_dir()
    except OSError:  # a name that is too long, say
        return False


def round_up(n: int) -> int:
    """1, 2, 5, 10, 20, 50, ...: a few sizes of network serve every batch."""
    size = 1
    while True:
        for factor in (1, 2, 5):
            if n <= size * factor:
                return size * factor
        size *= 10


def _cached(place: Path, n: int, sources: list[Path], name: str, build: Callable[[Path, int, Path], None]) -> Path:
    contents = tuple(source.read_bytes() for source in sources)
    return cached(f"{place.name}-{n}-{_digest(contents, n)}", name, partial(build, place, n))


@cache
def _digest(contents: tuple[bytes, ...], n: int) -> str:
    """Of all that copies are made from: sources, their number, netconvert and its recipe, and the code below."""
    digest = hashlib.sha256(f"{n} {netconvert_version()} {RECIPE}".encode() + Path(__file__).read_bytes())
    for content in contents:
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()[:16]


def parsed(source: Path) -> ElementTree.Element:
    """The root of an XML file.

    Raises
    ------
    InputError
        If it is not XML.
    """
    try:
        return ElementTree.parse(source).getroot()
    except ElementTree.ParseError as error:
        raise InputError(source, f"is not XML: {error}") from None


def _copies(sources: Sequence[Path], n: int) -> ElementTree.Element:
    """The children of each file's root n times, one file after the other, every id prefixed with the copy's number."""
    originals = [parsed(source) for source in sources]
    root = ElementTree.Element(originals[0].tag, originals[0].attrib)
    for copy, original in enumerate(original for original in originals for _ in range(n)):
        root.extend(_prefixed(child, copy) for child in original)
    return root


def _prefixed(element: ElementTree.Element, copy: int) -> ElementTree.Element:
    attributes = {
        name: " ".join(copied_id(copy, one) for one in value.split()) if name in _IDS.get(element.tag, ()) else value
        for name, value in element.attrib.items()}
    result = ElementTree.Element(element.tag, attributes)
    result.extend(_prefixed(child, copy) for child in element)
    return result


def _write(root: ElementTree.Element, file: Path) -> None:
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def _write_traffic(places: Sequence[Path], place: Path, n: int, into: Path) -> None:
    _write(_copies([one / TRAFFIC for one in places], n), into / TRAFFIC)


def _write_nobody(place: Path, n: int, into: Path) -> None:
    _write(_nobody(_copies([place / TRAFFIC], n)), into / NOBODY)


def _nobody(traffic: ElementTree.Element) -> ElementTree.Element:
    """Traffic without vehicles and persons."""
    nobody = ElementTree.Element("routes")
    nobody.extend(element for element in traffic if element.tag not in ("vehicle", "person"))
    return nobody


def _build_network(place: Path, n: int, into: Path) -> None:
    import sumo

    for source in SOURCES:
        _write(_copies([place / source], n), into / source)
    nodes, edges, connections = (str(into / source) for source in SOURCES)
    done = subprocess.run(
        [str(Path(sumo.SUMO_HOME) / "bin" / "netconvert"), "-n", nodes, "-e", edges, "-x", connections,
         "-o", str(into / ROADS), *RECIPE],
        capture_output=True, text=True, check=False)
    if done.returncode != 0:
        told = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[0]
        raise EnvironmentFault(f"{place}: netconvert refuses the network: {told}")
    _keep_the_net_alone(into / ROADS)


def _keep_the_net_alone(file: Path) -> None:
    """Without the head, which tells time and place of its making; a file that is not whole is an error."""
    try:
        text = file.read_text(encoding="utf-8")
        ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{file}: netconvert left half a network: {error}") from None
    file.write_text(text[text.index("<net "):], encoding="utf-8")
