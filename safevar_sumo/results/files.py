"""The files of a results directory: their names, contents and writers, and functions that write a whole file or nothing."""

from __future__ import annotations

import errno
import json
import os
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.output import whole_file
from safevar_sumo.plugins import DIGEST_LENGTH, Files
from safevar_sumo.study import Study, refuse_other_than_file

MANIFEST, SOLUTIONS, RUNS = "manifest.json", "solutions.csv", "runs"
ORIGINAL = "original"
"""Name of the original vehicle's journal; the study that writes it first owns the directory."""
FOLDERS_FILE, LATE_FILE_PATTERN = "places.json", "read-*.json"


class ResultsFile(NamedTuple):
    """A file of a results directory: its name, or a pattern of names; its content; and the command that writes it."""

    name: str
    content: str
    writer: str


FILES = (
    ResultsFile(MANIFEST, "the study as it was run, the original vehicle's metrics, versions and digests: "
                "[what results depend on](results.md)", "`study`, `import`"),
    ResultsFile(SOLUTIONS, "a row for each solution of each finished run", "`study` after its last run, `import`"),
    ResultsFile(f"{RUNS}/*-*.journal", "every evaluation of the run ALGORITHM-NN, from which an interrupted study continues",
                "`study` after each batch"),
    ResultsFile(f"{RUNS}/{ORIGINAL}.journal", "the original vehicle's evaluation", "`study` before its first run"),
    ResultsFile(f"{RUNS}/{FOLDERS_FILE}", "folders of your own code and files, relative to the directory", "`study` before its first run"),
    ResultsFile(f"{RUNS}/{LATE_FILE_PATTERN}", "a file that your own code read in the middle of a study, with its digest",
                "`study` after each batch"))
"""Every file of a results directory; the manual lists them."""


def run_name(algorithm: str, run: int) -> str:
    """The name of an algorithm's run in its journal and in messages, such as nsga2-03."""
    return f"{algorithm}-{run:02d}"


def journal_file(directory: Path, run: str) -> Path:
    """The journal of a run, by the run's name, or of the `ORIGINAL`."""
    return directory / RUNS / f"{run}.journal"


def stored_runs(directory: Path) -> set[str]:
    """Names of the runs that have a journal."""
    return {path.stem for path in (directory / RUNS).glob("*.journal")} - {ORIGINAL}


def make_directory(path: Path) -> None:
    """Make a directory for results, if there is none, and check that it can be written.

    Raises
    ------
    InputError
        If the directory cannot be written.
    """
    try:
        make_synced_directory(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        is_dangling = path.is_symlink() and not path.exists()
        problem = "it is a link whose target does not exist" if is_dangling else error.strerror
        raise InputError("out", f"cannot write to {path}: {problem}", "a directory that can be written") from None


def make_synced_directory(path: Path) -> None:
    """Make a directory and those above it, and sync them to the disk."""
    new_folders = [folder for folder in (path, *path.parents) if not folder.is_dir()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in new_folders:
        sync_directory(folder.parent)


def write_whole(path: Path, text: str) -> None:
    """Write a file as a whole or not at all.

    Raises
    ------
    SafevarError
        If the file cannot be written.
    """
    try:
        refuse_other_than_file(path)
        with whole_file(path) as temporary_file, open(temporary_file, "x", encoding="utf-8", newline="") as file:
            file.write(text)
        sync_directory(path.parent)
    except OSError as error:
        raise SafevarError(f"{path}: cannot be written: {error.strerror}; earlier data stays valid") from None


def sync_directory(path: Path) -> None:
    """Sync a directory to the disk, on systems that support it."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def write_folders(directory: Path, study: Study) -> None:
    """Record the folders of a study's files, relative to the directory; the manifest does not depend on them."""
    if study.origin.places:
        make_synced_directory(directory / RUNS)
        folders = [_relative_path(folder, directory.resolve()) for folder in study.origin.places]
        write_whole(directory / RUNS / FOLDERS_FILE, json.dumps(folders) + "\n")


def folders_of(directory: Path) -> tuple[str, ...]:
    """Folders of the user code and files of a directory's study: the recorded folders that exist, then the directory's two parents.

    Raises
    ------
    InputError
        If the record is damaged.
    """
    file = directory / RUNS / FOLDERS_FILE
    recorded_folders = _read_record(file, list[str], "the file as it was, or no file: the command `study` then writes it again")
    folders = [os.path.abspath(directory.resolve() / folder) for folder in recorded_folders or ()]
    return tuple(dict.fromkeys([*filter(os.path.isdir, folders), *map(str, directory.resolve().parents[:2])]))


def record_late_file(directory: Path, name: str, digest: str) -> None:
    """Record a file that was read after the study began, in a separate JSON file, because several processes may record files."""
    make_synced_directory(directory / RUNS)
    write_whole(_late_record(directory, name), json.dumps({name: digest}) + "\n")


def read_late_files(directory: Path) -> Files:
    """Digests, by file name, of the files that were read after the study began.

    Raises
    ------
    InputError
        If a record is damaged: an input of the results would be forgotten.
    """
    files: dict[str, str] = {}
    remedy = "the file as it was, or no file if every file that your own code reads is as it was when it was first read"
    for path in sorted((directory / RUNS).glob(LATE_FILE_PATTERN)):
        record = _read_record(path, dict[str, str], remedy) or {}
        if [_late_record(directory, name) for name in record] != [path]:
            raise InputError(path, "was edited: it does not hold the file that its name stands for", remedy)
        files |= record
    return files


def _late_record(directory: Path, name: str) -> Path:
    """The record of a file that was read after the study began; its name depends on the file's name."""
    return directory / RUNS / LATE_FILE_PATTERN.replace("*", sha256(name.encode()).hexdigest()[:DIGEST_LENGTH])


def _relative_path(folder: str, directory: Path) -> str:
    try:
        return os.path.relpath(folder, directory)
    except ValueError:  # on another drive
        return folder


Record = TypeVar("Record")


def _read_record(path: Path, kind: type[Record], remedy: str) -> Record | None:
    """The content of a JSON file beside the journals; None if there is no file.

    Raises
    ------
    InputError
        If the file cannot be read or is damaged; `remedy` names what the user can do.
    """
    try:
        refuse_other_than_file(path)
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(path, f"is torn or was edited: {error}", remedy) from None
