"""Files and directories of results: written whole or not at all, and still there after a power cut."""

from __future__ import annotations

import errno
import os
import secrets
import tempfile
from pathlib import Path

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.study import refuse_other_than_file


def make_directory(path: Path) -> None:
    """Make a directory for results, if there is none.

    Raises
    ------
    InputError
        If the directory cannot be written.
    """
    try:
        make_durable(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError("out", f"cannot write to {path}: {error.strerror}", "a directory that can be written") from None


def make_durable(path: Path) -> None:
    """Make a directory and those above it, and sync them to the disk."""
    missing = [folder for folder in (path, *path.parents) if not folder.is_dir()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in missing:
        sync_directory(folder.parent)


def write_whole(path: Path, text: str) -> None:
    """Write a file as a whole or not at all.

    Raises
    ------
    SafevarError
        If the file cannot be written.
    """
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"
    try:
        refuse_other_than_file(path)
        try:
            with open(temporary, "x", encoding="utf-8", newline="") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_directory(path.parent)
    except OSError as error:
        raise SafevarError(f"{path}: cannot be written: {error.strerror}; what was written before stays valid") from None


def sync_directory(path: Path) -> None:
    """Sync a directory to the disk, on systems that can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)
