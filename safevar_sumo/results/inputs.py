"""What a results directory tells of files: where its study's lie, which were read only after it had begun, whether its table was edited."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import DIGITS, Files, digest_of, located
from safevar_sumo.results.files import make_durable, write_whole
from safevar_sumo.results.manifest import DIGESTS, RUNS
from safevar_sumo.study import Study

PLACES, LATER = "places.json", "read-*.json"
"""Files beside the journals: folders of the study, relative to the results; and one for each file that was read later."""


def write_places(directory: Path, study: Study) -> None:
    """Keep where a study's files lie, relative to the directory: no part of the manifest, which is the same wherever they lie."""
    if study.origin.places:
        told = [_relative(place, directory.resolve()) for place in study.origin.places]
        make_durable(directory / RUNS)
        write_whole(directory / RUNS / PLACES, json.dumps(told) + "\n")


def places_of(directory: Path) -> tuple[str, ...]:
    """Folders in which the plug-ins and files of a directory's study are looked for.

    Those that the study had, if they are still there; then the folder that the directory lies in, and the one above.
    """
    told = _read(directory / RUNS / PLACES)
    known = [os.path.abspath(directory.resolve() / place) for place in told if isinstance(place, str)] if isinstance(told, list) else []
    return tuple(dict.fromkeys([*(place for place in known if os.path.isdir(place)), *map(str, directory.resolve().parents[:2])]))


def note_reading(directory: Path, name: str, digest: str) -> None:
    """Keep that a file was read after the study had begun; a file for each, so that nobody's note is lost to another process."""
    make_durable(directory / RUNS)
    write_whole(directory / RUNS / LATER.replace("*", sha256(name.encode()).hexdigest()[:DIGITS]), json.dumps({name: digest}) + "\n")


def read_later(directory: Path) -> Files:
    """Digests of files, by name, that were read after the study had begun."""
    notes = [_read(path) for path in sorted((directory / RUNS).glob(LATER))]
    return {str(name): str(digest) for note in notes if isinstance(note, dict) for name, digest in note.items()}


def begun_and_now(stored: Mapping[str, Any], now: Mapping[str, str], later: Mapping[str, str], places: Sequence[str]
                  ) -> tuple[dict[str, Any], Files]:
    """A stored manifest and the files that its study reads now, as they are to be held against each other.

    A file that was read later then, and is what it was, is in neither; one that has changed or is gone is in both.
    """
    begun, here = dict(stored.get("sources", {})), dict(now)
    for name, digest in later.items():
        if name not in begun:
            found = here.pop(name, None) or digest_of(located(name, places))
            if found != digest:
                begun[name], here[name] = digest, found
    return {**stored, "sources": begun}, {name: digest for name, digest in here.items() if digest}


def digest_of_table(text: str) -> str:
    """Tells tables of different content apart, whatever a platform makes of the ends of their lines."""
    return sha256(text.replace("\r\n", "\n").encode()).hexdigest()


def refuse_edited_table(file: Path, manifest: Mapping[str, Any], way_back: str) -> None:
    """Refuse a table that is not the one that was written; older manifests do not tell which that was.

    Raises
    ------
    InputError
        Naming the file.
    """
    digest = manifest.get(DIGESTS, {}).get(file.name)
    try:
        edited = digest is not None and digest_of_table(file.read_bytes().decode("utf-8", "replace")) != digest
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror or error}") from None
    if edited:
        raise InputError(file, "was edited: it does not hold what was computed", way_back)


def _relative(place: str, directory: Path) -> str:
    try:
        return os.path.relpath(place, directory)
    except ValueError:  # on another drive
        return place


def _read(path: Path) -> Any:
    """A small file of ours; None where it is not there or something else."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
