"""Built files in the user's cache folder: named by their sources, written atomically and checked before use."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import platformdirs

from safevar_sumo.errors import EnvironmentFault

CHECKSUM_ENDING = ".sha256"


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
    if not all(_is_intact(target / name) for name in names):
        try:
            target.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=target) as temporary:
                build(Path(temporary))
                for built in (Path(temporary) / name for name in names):
                    checksum = built.with_name(built.name + CHECKSUM_ENDING)
                    checksum.write_text(_sha256(built), encoding="ascii")
                    for file in (built, checksum):
                        os.replace(file, target / file.name)
        except OSError as error:
            raise EnvironmentFault(f"{target}: cannot write the cache of networks: {error.strerror or error}") from None
    return target


def _is_intact(target: Path) -> bool:
    try:
        return target.with_name(target.name + CHECKSUM_ENDING).read_text(encoding="ascii") == _sha256(target)
    except (OSError, UnicodeDecodeError):
        return False


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
