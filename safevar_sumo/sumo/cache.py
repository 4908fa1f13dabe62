"""Built files in the user's cache folder: named by their sources, written atomically and checked before use."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import platformdirs

from safevar_sumo.errors import EnvironmentFault

CHECKSUM_FILE = "checksum.sha256"


def ensure_cached(folder: str, name: str, build: Callable[[Path], None]) -> Path:
    """The path of a file in the cache; see `ensure_all_cached`."""
    return ensure_all_cached(folder, [name], build) / name


def ensure_all_cached(folder: str, names: Sequence[str], build: Callable[[Path], None]) -> Path:
    """The path of a folder in the cache with the named files, which are built if one is missing or damaged.

    Nothing waits for the disk: the checksum also finds what a power failure has left of a file.

    Parameters
    ----------
    folder
        Folder in the cache; different contents need different folders.
    build
        Function that writes the files into a given directory, always with the same bytes.

    Raises
    ------
    EnvironmentFault
        If the cache cannot be written.
    """
    target = platformdirs.user_cache_path("safevar_sumo") / "networks" / folder
    if not _is_intact(target, names):
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with _new_folder(target.parent) as new:
                build(new)
                (new / CHECKSUM_FILE).write_text(_checksum(new, names), encoding="ascii")
                _move(new, target)
        except OSError as error:
            raise EnvironmentFault(f"{target}: cannot write the cache of networks: {error.strerror or error}") from None
    return target


@contextmanager
def _new_folder(parent: Path) -> Iterator[Path]:
    """A new folder, which is removed unless it is moved: removing one takes milliseconds on some file systems, moving
    it does not.
    """
    folder = parent / f"new-{uuid4().hex}"
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _move(folder: Path, target: Path) -> None:
    try:
        folder.rename(target)
    except (
        OSError
    ):  # `target` exists: its files are missing or damaged, or another process was faster with the same bytes
        target.mkdir(exist_ok=True)  # Windows moves no folder of which a file is open
        for file in folder.iterdir():
            os.replace(file, target / file.name)


def _is_intact(folder: Path, names: Sequence[str]) -> bool:
    try:
        return (folder / CHECKSUM_FILE).read_text(encoding="ascii") == _checksum(folder, names)
    except (OSError, UnicodeDecodeError):
        return False


def _checksum(folder: Path, names: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for name in names:
        content = (folder / name).read_bytes()
        digest.update(f"{name} {len(content)} ".encode() + content)
    return digest.hexdigest()
