"""N copies of a SUMO network and its traffic, at the same coordinates and without connections between copies.

Netconvert builds the network once, by the recipe in its folder; then its elements are copied. The user's cache folder keeps the built
network and the copies, in folders named by the content of the sources.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

from safevar_sumo.errors import EnvironmentFault, InputError
from safevar_sumo.sumo import copies
from safevar_sumo.sumo.cache import ensure_cached
from safevar_sumo.sumo.copies import check_roads, parse_xml, write_demand, write_roads
from safevar_sumo.sumo.sources import OPTIONS_FILE, TRAFFIC_FILE, Sources, sources_of

NETWORK_FILE = "network.net.xml"
LOAD_MARK_FILE = "tried.txt"
RECIPE_OPTIONS = ("--xml-validation", "never")
"""Options of netconvert and SUMO for every network."""


class CopiedNetwork(NamedTuple):
    """The files of N copies, and the file with SUMO's options."""

    network: Path
    traffic: Path
    options: Path


def copied_network(folder: str, n: int) -> CopiedNetwork:
    """At least `n` copies of a network, of which `n` have traffic; `folder` is a network as in `sources_of`.

    Raises
    ------
    InputError
        If the folder or a source is missing, a source is not XML, or netconvert refuses the sources.
    EnvironmentFault
        If netconvert fails for another reason, or the cache cannot be written.
    """
    sources = sources_of(folder)
    size = round_up(n)
    roads = ensure_cached(_cache_folder(sources, size, sources.road_files), NETWORK_FILE, partial(_copy_roads, sources, size))
    traffic = ensure_cached(_cache_folder(sources, n, (TRAFFIC_FILE,)), TRAFFIC_FILE, partial(_copy_demand, sources, n))
    return CopiedNetwork(roads, traffic, sources.folder / OPTIONS_FILE)


def built_network(folder: str) -> Path:
    """The file of the original network, which netconvert or the user built; raises the errors of `copied_network`."""
    return _build_if_needed(sources_of(folder))


def try_network(folder: str) -> None:
    """Load a network with its options and traffic in SUMO, unless SUMO has loaded it before; raises the errors of `copied_network`."""
    sources = sources_of(folder)
    ensure_cached(_cache_folder(sources, 0, sources.files), LOAD_MARK_FILE, partial(_try_traffic, sources, _build_if_needed(sources)))


def lanes_of(folder: str) -> int:
    """Number of lanes of a network, junctions included; raises the errors of `copied_network`."""
    file = built_network(folder)
    return _count_lanes(file, file.stat().st_mtime_ns)


@cache
def _count_lanes(file: Path, modification_time: int) -> int:
    return file.read_bytes().count(b"<lane ")


def network_fingerprint(folder: str) -> str:
    """A fingerprint of the content of a network: sources, traffic and options."""
    return ":".join(network_files(folder).values())


def network_files(folder: str) -> dict[str, str]:
    """A digest of each source file of a network, by file name."""
    sources = sources_of(folder)
    contents = sources.contents(*sources.files)
    return {name: hashlib.sha256(content).hexdigest()[:16] for name, content in zip(sources.files, contents, strict=True)}


@cache
def netconvert_version() -> str:
    """Version of SUMO, and thus of netconvert."""
    from importlib.metadata import version

    return version("eclipse-sumo")


def round_up(n: int) -> int:
    """Round up to 1, 2, 5, 10, 20, 50, ..., so that few sizes of networks serve all batches."""
    size = 1
    while True:
        for factor in (1, 2, 5):
            if n <= size * factor:
                return size * factor
        size *= 10


def _cache_folder(sources: Sources, n: int, files: Sequence[str]) -> str:
    """Name of the folder in the cache for `n` copies that are made from these files."""
    digest = _digest(sources.contents(*files), f"{n} {sources.plain_files} {sources.options}")
    return f"{re.sub(r'[^a-zA-Z0-9_.-]', '_', sources.folder.name)}-{n}-{digest}"  # SUMO splits file names at commas


@cache
def _digest(contents: tuple[bytes, ...], build_options: str) -> str:
    """A digest of all that determines copies: sources, options of the build, netconvert's version and recipe, and this package's code."""
    code = b"".join(Path(str(module)).read_bytes() for module in (__file__, copies.__file__))
    digest = hashlib.sha256(f"{build_options} {netconvert_version()} {RECIPE_OPTIONS}".encode() + code)
    for content in contents:
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()[:16]


def _copy_roads(sources: Sources, n: int, into: Path) -> None:
    write_roads(_read_roads(_build_if_needed(sources)), n, into / NETWORK_FILE)


def _copy_demand(sources: Sources, n: int, into: Path) -> None:
    write_demand(parse_xml(sources.folder / TRAFFIC_FILE), n, into / TRAFFIC_FILE)


def _build_if_needed(sources: Sources) -> Path:
    if sources.network_file:
        ensure_cached(_cache_folder(sources, 0, sources.road_files), LOAD_MARK_FILE, partial(_try_roads, sources))
        return sources.folder / sources.network_file
    return ensure_cached(_cache_folder(sources, 0, sources.road_files), NETWORK_FILE, partial(_build, sources))


def _read_roads(file: Path) -> ElementTree.Element:
    root = parse_xml(file)
    check_roads(root, file)
    return root


def _run_program(sources: Sources, program: str, *arguments: str) -> tuple[int, str]:
    """Run a program of SUMO in a network's folder; return its exit code and error messages."""
    import sumo

    process = subprocess.run([str(Path(sumo.SUMO_HOME) / "bin" / program), *arguments, *RECIPE_OPTIONS], capture_output=True, text=True,
                          errors="replace", check=False, cwd=sources.folder, env={**os.environ, "SUMO_HOME": sumo.SUMO_HOME})
    lines = [line.strip() for line in process.stderr.splitlines() if line.strip() and not line.startswith(("Warning:", "Quitting"))]
    return process.returncode, " ".join(lines).removeprefix("Error: ")[:500]


def _try_roads(sources: Sources, into: Path) -> None:
    """Load a network built by the user, in a separate SUMO process because some broken networks crash SUMO."""
    _read_roads(sources.folder / sources.network_file)
    exit_code, errors = _run_program(sources, "sumo", "-n", sources.network_file, "--no-step-log", "true", "--end", "0")
    if exit_code != 0:
        raise InputError(sources.folder / sources.network_file, f"SUMO cannot load it: {errors or f'exit code {exit_code}'}",
                         "a network of SUMO")
    (into / LOAD_MARK_FILE).write_text("SUMO loads it.\n", encoding="ascii")


def _try_traffic(sources: Sources, network_file: Path, into: Path) -> None:
    exit_code, errors = _run_program(sources, "sumo", "-c", OPTIONS_FILE, "-n", str(network_file.absolute()), "-r", TRAFFIC_FILE, "--begin",
                             "0", "--end", "0", "--no-step-log", "true")
    if exit_code != 0 or errors:
        raise InputError(sources.folder, f"SUMO refuses {OPTIONS_FILE} or {TRAFFIC_FILE}: {errors or f'exit code {exit_code}'}",
                         "options and traffic that SUMO loads without an error")
    (into / LOAD_MARK_FILE).write_text("SUMO loads it.\n", encoding="ascii")


def _build(sources: Sources, into: Path) -> None:
    command = list[str]()
    for option, names in sources.plain_files:
        command += [f"--{option}", ",".join(names)]
    for option, value in sources.options:
        command += [f"--{option}", value]
    exit_code, errors = _run_program(sources, "netconvert", *command, "-o", str(into / NETWORK_FILE))
    if exit_code != 0:
        if exit_code < 0 or not errors or ("Could not" in errors and "output" in errors) or "bad_alloc" in errors:
            raise EnvironmentFault(f"{sources.folder}: netconvert fails: {errors or f'exit code {exit_code}'}")
        raise InputError(sources.folder, f"netconvert refuses the network: {errors}", "sources that netconvert builds a network from")
    _drop_header(into / NETWORK_FILE)


def _drop_header(file: Path) -> None:
    """Remove the header, which contains the time and options of the build; raise an error if the file is incomplete."""
    try:
        text = file.read_text(encoding="utf-8")
        ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{file}: netconvert left an incomplete network: {error}") from None
    file.write_text(text[text.index("<net "):], encoding="utf-8")
