"""The files of a results directory, and its manifest: the inputs that its results depend on, and
their differences from other inputs.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from msgspec import Struct

from safevar_sumo.errors import InputError, SafevarError, about
from safevar_sumo.output import whole_file
from safevar_sumo.records import JsonObject
from safevar_sumo.study import PYMOO, Study, convert_table, tables_of, with_effect
from safevar_sumo.study.schema import Tables

FORMAT = 6
"""Version number of the files' format."""
RESULTS = 11
"""Version number of the package's results, raised whenever they change (enforced by tests/golden).
"""
PACKAGES = ("safevar_sumo", "libsumo", "deap", "numpy")
"""Packages that every study uses."""
LIBRARIES = {"ad_rss": "ad-rss", "highway_idm": "highway-env", "fmu": "fmpy"}
"""Packages of extras by the driving system, or the kind of one, that needs them."""
SIMULATORS = ("libsumo", *LIBRARIES.values())
"""Packages on whose versions a single simulation depends."""
PYMOO_PACKAGES = ("pymoo", "cma")
"""Packages on whose versions the searches of pymoo depend."""
IDENTITY = {
    "study": "the same study and options",
    "files": "the file as it was",
    "results": "that version",
    "versions": "those versions",
    "platform": "such a machine",
}
"""Inputs that results depend on, each with the remedy if it has changed; an error says "expected:
another `out` ..., or REMEDY".
"""
MANIFEST, SOLUTIONS, RUNS = "manifest.json", "solutions.csv", "runs"
FILES = (
    (
        MANIFEST,
        (
            "the study as it was run, the original vehicle's metrics, versions, digests of files,"
            " and folders of your own code and files: [what results depend on](results.md)"
        ),
        "`study`, `import`",
    ),
    (
        SOLUTIONS,
        "a row for each solution of each finished run",
        "`study` after its last run, `import`",
    ),
    (
        f"{RUNS}/*-*.jsonl",
        "every evaluation of the run ALGORITHM-NN, from which an interrupted study continues",
        "`study` after each batch",
    ),
)
"""Every file of a results directory: its name or a pattern of names, its content, and the command
that writes it.
"""


def run_name(algorithm: str, run: int) -> str:
    """The name of an algorithm's run in its journal and in messages, such as nsga2-03."""
    return f"{algorithm}-{run:02d}"


def journal_file(directory: Path, run: str) -> Path:
    """The journal of a run, by the run's name.

    Raises
    ------
    InputError
        If something else is there, such as a folder, or a pipe, which would be waited for.
    """
    path = directory / RUNS / f"{run}.jsonl"
    if path.exists() and not path.is_file():
        raise InputError(
            path, "is no file", "the journal that was there, or no file: the run then begins anew"
        )
    return path


def stored_runs(directory: Path) -> set[str]:
    """Names of the runs that have a journal."""
    return {path.stem for path in (directory / RUNS).glob("*.jsonl")}


def make_directory(path: Path) -> None:
    """Make a directory for results, if there is none, and check that it can be written.

    Raises
    ------
    InputError
        If the directory cannot be written, or something else is in place of one of its files.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        is_dangling = path.is_symlink() and not path.exists()
        problem = "it is a link whose target does not exist" if is_dangling else error.strerror
        raise InputError(
            "out", f"cannot write to {path}: {problem}", "a directory that can be written"
        ) from None
    for name, is_right in {
        MANIFEST: Path.is_file,
        SOLUTIONS: Path.is_file,
        RUNS: Path.is_dir,
    }.items():
        if (path / name).exists() and not is_right(path / name):
            problem = f"is no {'folder' if name == RUNS else 'file'}"
            raise InputError(path / name, problem, "nothing of this name, or another `out`")


def write_whole(path: Path, text: str) -> None:
    """Write a file as a whole or not at all.

    Raises
    ------
    SafevarError
        If the file cannot be written.
    """
    with (
        disk_errors(path, "written"),
        whole_file(path) as temporary_file,
        open(temporary_file, "w", encoding="utf-8", newline="") as file,
    ):
        file.write(text)


@contextmanager
def disk_errors(path: Path, action: str) -> Iterator[None]:
    """Turn an error of the operating system into the error that `path` cannot be read, written,
    opened or removed.
    """
    try:
        yield
    except OSError as error:
        raise SafevarError(
            f"{path}: cannot be {action}: {error.strerror}; earlier data stays valid"
        ) from None


def manifest_of(study: Study, identity: Tables) -> JsonObject:
    """The manifest of a study as it is run, without the original vehicle's evaluation.

    Parameters
    ----------
    identity
        Inputs of the results besides the study file, by `IDENTITY`; see
        `safevar_sumo.campaign.identity.identity_of`.
    """
    return {
        "format": FORMAT,
        "study": tables_of(study),
        **identity,
        "versions": {name: version(name) for name in packages_of(study)},
    }


def packages_of(study: Study) -> tuple[str, ...]:
    """The packages that a study uses, and on whose versions its results depend; those of pymoo only
    where it is installed, as no question about the study needs it.
    """
    has_pymoo = any(name.startswith(PYMOO) for name in study.search.algorithms)
    has_pymoo = has_pymoo and find_spec("pymoo") is not None
    libraries = [LIBRARIES[key] for key in (study.ads.model, study.ads.kind) if key in LIBRARIES]
    return (*PACKAGES, *libraries, *(PYMOO_PACKAGES if has_pymoo else ()))


def evaluation_keys(tables: Tables) -> JsonObject:
    """Those of a study's tables that affect evaluations."""
    keys: JsonObject = with_effect(tables, Study)
    return keys


def identity_in(manifest: JsonObject) -> JsonObject:
    """The inputs of a manifest, by `IDENTITY`."""
    layers = {layer: manifest.get(layer, {}) for layer in IDENTITY}
    return {**layers, "study": evaluation_keys(manifest["study"])}


def identity_digest(manifest: JsonObject) -> str:
    """The digest that identifies a manifest's study in its journals, whether or not it has searches
    of pymoo.
    """
    layers = identity_in(manifest)
    versions = {
        name: value for name, value in layers["versions"].items() if name not in PYMOO_PACKAGES
    }
    return sha256(json.dumps({**layers, "versions": versions}, sort_keys=True).encode()).hexdigest()


def manifest_differences(stored: JsonObject, now: JsonObject) -> Iterator[tuple[str, str, bool]]:
    """The differences between the inputs of two manifests: of stored results, and of now.

    Yields, for each, its layer of `IDENTITY`, a text, and whether it may change simulations. Other
    search libraries, other machines, other versions of this package with the same `RESULTS`, and
    new keys of a study do not.
    """
    inputs_before = identity_in(stored)
    for layer, inputs in identity_in(now).items():
        for key, before, after in changed_values(inputs_before[layer], inputs):
            if key in PYMOO_PACKAGES and None in (before, after):
                continue
            if layer == "files":
                change = "is new" if before is None else "has changed since"
                text = f"{key} no longer exists" if after is None else f"{key} {change}"
            else:
                name = (
                    f"version of {key}"
                    if layer == "versions"
                    else key or "the version of the package's results"
                )
                text = f"{name} was {before!r} and is {after!r} now"
            is_harmless = (
                layer == "platform"
                or (layer == "versions" and key not in SIMULATORS)
                or (layer == "study" and before is None)
            )
            yield layer, text, not is_harmless


def search_extent_of(manifest: JsonObject) -> tuple[list[str], int, int]:
    """Algorithms, runs and evaluations of a study: they decide which solutions the table of
    solutions has.
    """
    search = manifest["study"]["search"]
    return search["algorithms"], search["runs"], search["evaluations"]


def write_manifest(directory: Path, manifest: JsonObject) -> None:
    """Write a manifest."""
    write_whole(directory / MANIFEST, json.dumps(manifest, indent=2, allow_nan=False) + "\n")


class _Manifest(Struct):
    """What a reader of a manifest relies on; imported results have neither `files` nor
    `folders`.
    """

    study: Study
    versions: dict[str, str]
    original: dict[str, bool | float | str | None]
    files: dict[str, str] = {}
    folders: list[str] = []


def read_manifest(directory: Path) -> JsonObject:
    """The manifest of a results directory.

    Raises
    ------
    InputError
        If there is no manifest, or it is damaged, was edited, or is of another format.
    """
    # The manifest, in whatever format it is.
    file = directory / MANIFEST
    try:
        manifest = json.loads(file.read_text(encoding="utf-8", errors="replace"))
        written_by = manifest["versions"]["safevar_sumo"]
        format_number = manifest.get("format", 1)
    except (FileNotFoundError, NotADirectoryError):
        likely_path = Path("results") / directory.name
        hint = (
            f"; did you mean {likely_path}?"
            if likely_path != directory and likely_path.is_dir()
            else ""
        )
        problem = f"is not a results directory: there is no {MANIFEST}{hint}"
        raise InputError(directory, problem, "a directory written by the command `study`") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problem = f"cannot be read, is torn or was edited: {error!r}"
        raise InputError(
            file, problem, "the file as it was, or no file: the same command then writes it again"
        ) from None

    # Results in another format are those of another release.
    if format_number != FORMAT:
        raise InputError(
            directory,
            f"holds results in format {format_number}; this version reads format {FORMAT}",
            f"the release that wrote them, safevar_sumo {written_by}; or another `out`",
        )
    with about(file):
        convert_table(manifest, _Manifest)
    return dict(manifest)


def folders_of(directory: Path, manifest: JsonObject) -> tuple[str, ...]:
    """Folders of the user code and files of a directory's study: those of the manifest that exist,
    then the nearest two folders that contain the directory.
    """
    folders = [
        os.path.abspath(directory.resolve() / folder) for folder in manifest.get("folders", ())
    ]
    return tuple(
        dict.fromkeys([*filter(os.path.isdir, folders), *map(str, directory.resolve().parents[:2])])
    )


def changed_values(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The innermost keys at which two values differ, with the first and the second value; 2 and 2.0
    are different.
    """
    if isinstance(first, dict) and isinstance(second, dict):
        for name in sorted({*first, *second}):
            yield from changed_values(
                first.get(name), second.get(name), f"{key}.{name}" if key else name
            )
    elif json.dumps(first, sort_keys=True) != json.dumps(second, sort_keys=True):
        yield key, first, second
