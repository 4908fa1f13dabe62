"""Built files in the user's cache folder: named by their sources, written atomically and checked before use."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import platformdirs

from safevar_sumo.errors import EnvironmentFault

CHECKSUM_ENDING = ".sha256"


def ensure_cached(folder: str, name: str, build: Callable[[Path], None]) -> Path:
    """The path of a file in the cache; the file is built if it is missing or damaged.

    Parameters
    ----------
    folder
        Folder in the cache; different contents need different folders.
    build
        Function that writes the file `name` into a given directory, always with the same bytes.

    Raises
    ------
    EnvironmentFault
        If the cache cannot be written.
    """
    target = platformdirs.user_cache_path("safevar_sumo") / "networks" / folder / name
    if not _is_intact(target):
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=target.parent) as temporary:
                build(Path(temporary))
                built = Path(temporary) / name
                checksum = built.with_name(name + CHECKSUM_ENDING)
                checksum.write_text(_sha256(built), encoding="ascii")
                for file in (built, checksum):
                    _sync(file)
                    os.replace(file, target.with_name(file.name))
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


def _sync(file: Path) -> None:
    with file.open("r+b") as handle:
        os.fsync(handle.fileno())
