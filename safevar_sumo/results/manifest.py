"""The files of a results directory: their names; and functions that write and read the manifest."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from msgspec import Struct

from safevar_sumo.errors import InputError, SafevarError, about
from safevar_sumo.output import read_file, whole_file
from safevar_sumo.records import JsonObject
from safevar_sumo.results.identity import FORMAT
from safevar_sumo.study import Study, convert_table

MANIFEST = "manifest.json"
SOLUTIONS = "solutions.csv"
RUNS = "runs"
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
        If something else has this name, such as a folder, or a pipe, on which a reader would wait.
    """
    path = directory / RUNS / f"{run}.jsonl"
    if path.exists() and not path.is_file():
        raise InputError(
            path,
            "is no file",
            "the journal that was there, or no file: the run then begins anew",
        )
    return path


def make_directory(path: Path) -> None:
    """Make a directory for results, if there is none, and check that it can be written.

    Raises
    ------
    InputError
        If the directory cannot be written, or a name of its files belongs to something else, such
        as a folder.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        problem = error.strerror
        if path.is_symlink() and not path.exists():
            problem = "it is a link whose target does not exist"
        raise InputError(
            "out",
            f"cannot write to {path}: {problem}",
            "a directory that can be written",
        ) from None
    for name, kind, is_right in (
        (MANIFEST, "file", Path.is_file),
        (SOLUTIONS, "file", Path.is_file),
        (RUNS, "folder", Path.is_dir),
    ):
        if (path / name).exists() and not is_right(path / name):
            raise InputError(
                path / name, f"is no {kind}", "nothing of this name, or another `out`"
            )


def write_whole(path: Path, text: str) -> None:
    """Write a file as a whole or not at all.

    Raises
    ------
    SafevarError
        If the file cannot be written.
    """
    with disk_errors(path, "written"), whole_file(path) as file:
        file.write_text(text, encoding="utf-8", newline="")


@contextmanager
def disk_errors(path: Path, action: str) -> Iterator[None]:
    """Context that turns an error of the operating system into a SafevarError: `path` cannot be
    read, written, opened or removed (`action`).
    """
    try:
        yield
    except OSError as error:
        raise SafevarError(
            f"{path}: cannot be {action}: {error.strerror}; earlier data stays valid"
        ) from None


def write_manifest(directory: Path, manifest: JsonObject) -> None:
    """Write a manifest."""
    write_whole(
        directory / MANIFEST, json.dumps(manifest, indent=2, allow_nan=False) + "\n"
    )


OriginalRecord = dict[str, bool | float | str | None]
"""The results of the original vehicle by name."""


class _Manifest(Struct):
    """The keys on which readers of a manifest rely; reading checks their types. Imported results
    have neither `files` nor `folders`.
    """

    study: Study
    versions: dict[str, str]
    original: OriginalRecord
    files: dict[str, str] = {}
    folders: list[str] = []


def read_manifest(directory: Path) -> JsonObject:
    """The manifest of a results directory.

    Raises
    ------
    InputError
        If there is no manifest, or it is damaged, was edited, or is of another format.
    """
    file = directory / MANIFEST
    try:
        manifest = json.loads(read_file(file).decode(errors="replace"))
        written_by = manifest["versions"]["safevar_sumo"]
        format_number = manifest.get("format", 1)
    except (FileNotFoundError, NotADirectoryError):
        likely_path = Path("results") / directory.name
        problem = f"is not a results directory: there is no {MANIFEST}"
        if likely_path != directory and likely_path.is_dir():
            problem += f"; did you mean {likely_path}?"
        raise InputError(
            directory, problem, "a directory written by the command `study`"
        ) from None
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise InputError(
            file,
            f"cannot be read, is torn or was edited: {error!r}",
            "the file as it was, or no file: the same command then writes it again",
        ) from None
    legal = f"the release that wrote them, safevar_sumo {written_by}; or another `out`"
    if format_number != FORMAT:
        raise InputError(
            directory,
            f"holds results in format {format_number}; this version reads format {FORMAT}",
            legal,
        )

    # Older releases wrote keys that have no effect any more: they are no reason to refuse results.
    study = manifest.get("study")
    if isinstance(study, dict):
        for key in ("wider", "correlations"):
            study.pop(key, None)
        if "search" in (study.get("scenario") or ()):
            raise InputError(
                directory, "holds results of a study with [scenario.search]", legal
            )
    with about(file):
        convert_table(manifest, _Manifest)
    return dict(manifest)


def folders_of(directory: Path, manifest: JsonObject) -> tuple[str, ...]:
    """The folders in which to look for the user code and files of a directory's study: the existing
    folders that the manifest names, then the two nearest folders that contain the directory.
    """
    base = directory.resolve()
    folders = [os.path.abspath(base / folder) for folder in manifest.get("folders", ())]
    places = [folder for folder in folders if os.path.isdir(folder)]
    places += [str(parent) for parent in base.parents[:2]]
    return tuple(dict.fromkeys(places))
