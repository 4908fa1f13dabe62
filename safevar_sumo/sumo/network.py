"""N copies of a SUMO network and its traffic: same coordinates, no connection between them.

Netconvert builds the network once, by its folder's recipe, and its elements are copied. Both are kept in the
user's cache folder, named by the content of their sources.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import EnvironmentFault, InputError
from safevar_sumo.sumo import copies
from safevar_sumo.sumo.cache import cached
from safevar_sumo.sumo.copies import check_roads, parsed, write_demand, write_roads
from safevar_sumo.sumo.demand import check_demand, unused
from safevar_sumo.sumo.sources import OPTIONS, TRAFFIC, Sources, check_options, is_shipped, options_of, sources_of

ROADS = "network.net.xml"
TRIED = "tried.txt"
RECIPE = ("--xml-validation", "never")
"""Options of netconvert for every network."""


class CopiedNetwork(NamedTuple):
    """Files of N copies, and the options that SUMO runs them with."""

    network: Path
    traffic: Path
    options: Path


def copied_network(folder: str, n: int) -> CopiedNetwork:
    """At least `n` copies of a network with traffic in `n` of them; see `sources_of` for what `folder` may be.

    Raises
    ------
    InputError
        If the folder or one of its sources is missing, is not XML, or netconvert refuses it.
    EnvironmentFault
        If netconvert fails otherwise or the cache cannot be written.
    """
    sources = sources_of(folder)
    size = round_up(n)
    roads = cached(_name(sources, size, sources.roads), ROADS, partial(_copy_roads, sources, size))
    traffic = cached(_name(sources, n, (TRAFFIC,)), TRAFFIC, partial(_copy_demand, sources, n))
    return CopiedNetwork(roads, traffic, sources.place / OPTIONS)


def built_network(folder: str) -> Path:
    """The original network, built by netconvert or given as built; raises the errors of `copied_network`."""
    return _built(sources_of(folder))


def try_network(folder: str) -> None:
    """Load a network with its options and traffic in SUMO, once for each content; raises the errors of `copied_network`."""
    sources = sources_of(folder)
    cached(_name(sources, 0, sources.files), TRIED, partial(_try_all, sources, _built(sources)))


def lanes_of(folder: str) -> int:
    """Number of lanes of a network, including those of junctions; raises the errors of `copied_network`."""
    file = built_network(folder)
    return _lanes(file, file.stat().st_mtime_ns)


@cache
def _lanes(file: Path, changed: int) -> int:
    return file.read_bytes().count(b"<lane ")


def network_fingerprint(folder: str) -> str:
    """A fingerprint of a network's content: sources, traffic and options."""
    return ":".join(network_files(folder).values())


def network_files(folder: str) -> dict[str, str]:
    """A digest of every source file of a network, by name."""
    sources = sources_of(folder)
    contents = sources.contents(*sources.files)
    return {name: hashlib.sha256(content).hexdigest()[:16] for name, content in zip(sources.files, contents, strict=True)}


def netconvert_version() -> str:
    """Version of SUMO, which builds and simulates."""
    from importlib.metadata import version

    return version("eclipse-sumo")


def round_up(n: int) -> int:
    """1, 2, 5, 10, 20, 50, ...: a few sizes of network serve every batch."""
    size = 1
    while True:
        for factor in (1, 2, 5):
            if n <= size * factor:
                return size * factor
        size *= 10


def _name(sources: Sources, n: int, files: Sequence[str]) -> str:
    """Folder in the cache of `n` copies made from these files."""
    digest = _digest(sources.contents(*files), f"{n} {sources.plain} {sources.options}")
    return f"{re.sub(r'[^a-zA-Z0-9_.-]', '_', sources.place.name)}-{n}-{digest}"  # SUMO splits file names at commas


@cache
def _digest(contents: tuple[bytes, ...], build: str) -> str:
    """A digest of everything that determines copies: sources, build options (`build`), netconvert and its recipe, and our code."""
    code = b"".join(Path(str(module)).read_bytes() for module in (__file__, copies.__file__))
    digest = hashlib.sha256(f"{build} {netconvert_version()} {RECIPE}".encode() + code)
    for content in contents:
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()[:16]


def _copy_roads(sources: Sources, n: int, into: Path) -> None:
    write_roads(_checked(_built(sources)), n, into / ROADS)


def _copy_demand(sources: Sources, n: int, into: Path) -> None:
    write_demand(parsed(sources.place / TRAFFIC), n, into / TRAFFIC)


def _built(sources: Sources) -> Path:
    if sources.built:
        cached(_name(sources, 0, sources.roads), TRIED, partial(_try, sources))
        return sources.place / sources.built
    return cached(_name(sources, 0, sources.roads), ROADS, partial(_build, sources))


def _checked(file: Path) -> ElementTree.Element:
    root = parsed(file)
    check_roads(root, file)
    return root


def _run(sources: Sources, program: str, *arguments: str) -> tuple[int, str]:
    """Run a program of SUMO in a network's folder; returns its exit code and its errors."""
    import sumo

    process = subprocess.run([str(Path(sumo.SUMO_HOME) / "bin" / program), *arguments, *RECIPE], capture_output=True, text=True,
                          errors="replace", check=False, cwd=sources.place, env={**os.environ, "SUMO_HOME": sumo.SUMO_HOME})
    lines = [line.strip() for line in process.stderr.splitlines() if line.strip() and not line.startswith(("Warning:", "Quitting"))]
    return process.returncode, " ".join(lines).removeprefix("Error: ")[:500]


def _try(sources: Sources, into: Path) -> None:
    """Load a network that the user built in a separate SUMO process, which some broken networks crash."""
    _checked(sources.place / sources.built)
    code, errors = _run(sources, "sumo", "-n", sources.built, "--no-step-log", "true", "--end", "0")
    if code != 0:
        raise InputError(sources.place / sources.built, f"SUMO cannot load it: {errors or f'it dies with exit code {code}'}",
                         "a network of SUMO")
    (into / TRIED).write_text("SUMO loads it.\n", encoding="ascii")


def _try_all(sources: Sources, built: Path, into: Path) -> None:
    code, errors = _run(sources, "sumo", "-c", OPTIONS, "-n", str(built.absolute()), "-r", TRAFFIC, "--begin", "0", "--end", "0",
                      "--no-step-log", "true")
    if code != 0 or errors:
        raise InputError(sources.place, f"SUMO refuses {OPTIONS} or {TRAFFIC}: {errors or f'it dies with exit code {code}'}",
                         "options and traffic that SUMO loads without an error")
    (into / TRIED).write_text("SUMO loads it.\n", encoding="ascii")


def _build(sources: Sources, into: Path) -> None:
    command = list[str]()
    for option, names in sources.plain:
        command += [f"--{option}", ",".join(names)]
    for option, value in sources.options:
        command += [f"--{option}", value]
    code, errors = _run(sources, "netconvert", *command, "-o", str(into / ROADS))
    if code != 0:
        if code < 0 or not errors or ("Could not" in errors and "output" in errors) or "bad_alloc" in errors:
            raise EnvironmentFault(f"{sources.place}: netconvert fails: {errors or f'exit code {code}'}")
        raise InputError(sources.place, f"netconvert refuses the network: {errors}", "sources that netconvert builds a network from")
    _drop_header(into / ROADS)


def _drop_header(file: Path) -> None:
    """Drop the header, which holds time and options of the build; raise an error if the file is incomplete."""
    try:
        text = file.read_text(encoding="utf-8")
        ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{file}: netconvert left an incomplete network: {error}") from None
    file.write_text(text[text.index("<net "):], encoding="utf-8")


SHORTEST_STEP, LONGEST_STEP = 0.001, 1.0
"""SUMO's shortest time step, and the longest in which a vehicle could react in time [s]."""
ABOVE_0: Mapping[str, tuple[str, ...]] = {
    "vType": ("length", "width", "height", "maxSpeed", "accel", "decel", "mass"),
    "edge": ("length", "width", "speed"), "lane": ("length", "width", "speed"),
}
FROM_0: Mapping[str, tuple[str, ...]] = {"vType": ("minGap", "tau", "actionStepLength"), "walk": ("speed",)}
"""Attributes of elements that must be positive numbers, and those that must not be negative."""
UNSET = "-1"
"""Value of an attribute in netconvert's sources that means that the attribute is not set."""


def check_network(network: str) -> None:
    """Refuse a network that cannot be simulated correctly.

    Raises
    ------
    InputError
        Naming the file, the illegal value, and legal ones.
    EnvironmentFault
        If the network cannot be built for reasons outside it.
    """
    _check(network, network_fingerprint(network))


def network_remarks(network: str, fastest: float, *, sumo_drives: bool) -> list[str]:
    """Remarks on parts of a user's network that the simulation does not use; see `unused`. None for shipped networks."""
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
        _check_numbers(parsed(sources.place / name), sources.place / name, UNSET if name != TRAFFIC else "")
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
    """Refuse a network that was edited in netedit after its sources, which lack those changes."""
    file = sources.place / (sources.builds or ROADS)
    if sources.built or not file.is_file() or any((sources.place / name).stat().st_mtime >= file.stat().st_mtime for name in sources.roads):
        return
    head, _, net = file.read_text(encoding="utf-8", errors="replace").partition("<net ")
    if "netedit" in head and f"<net {net}".strip() != built.strip():
        raise InputError(file, f"was saved by netedit after {', '.join(sources.roads)}, which build another network",
                         "plain XML saved from netedit, too; or a folder without those files, to use the network as it is")


def _check_step(file: Path) -> None:
    step = options_of(file).get("step-length", "1")
    if not SHORTEST_STEP <= _number(step) <= LONGEST_STEP:
        raise InputError(file, f"step-length = {step!r}", f"a number from {SHORTEST_STEP:g} to {LONGEST_STEP:g} [s]")


def _check_numbers(root: ElementTree.Element, file: Path, unset: str = "") -> None:
    """Refuse impossible lengths, speeds and accelerations."""
    for element in root.iter():
        for names, above, legal in ((ABOVE_0, True, "a number above 0"), (FROM_0, False, "a number from 0 on")):
            for name in names.get(element.tag, ()):
                text = element.get(name, unset)
                if text == unset or (number := _number(text)) > 0 or (number == 0 and not above):
                    continue
                called = f"{element.tag} {element.get('id')!r}" if "id" in element.attrib else element.tag
                raise InputError(file, f"{called}: {name} = {text!r}", legal)


def _number(text: str) -> float:
    """A finite number, or -infinity if the text is none."""
    try:
        number = float(text)
    except ValueError:
        return -math.inf
    return number if math.isfinite(number) else -math.inf
