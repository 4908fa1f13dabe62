"""Files that users name: regular input files; output files, written as a whole or not at all; and
files beside a study. Temporary files and folders, also those of killed processes.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from glob import escape
from pathlib import Path

import portalocker

from safevar_sumo.errors import InputError

ALONE = portalocker.LOCK_EX | portalocker.LOCK_NB
SETTLING_TIME = 0.1
"""Time within which a process locks a temporary file that it has made [s]."""
PREFIX, LOCK = "safevar-", "lock"
"""Beginning of the names of temporary folders, and the file in them that their process has locked.
"""
MAX_INPUT = 100_000_000
"""Largest size of an input file [bytes]."""
MAX_UNPACKED = 1_000_000_000
"""Largest size of all files of an archive together, unpacked [bytes]."""
WRITABLE = "a file in a directory that can be written, with space for it"
"""What an error about an output file expects."""


def read_file(path: Path, largest: int = MAX_INPUT) -> bytes:
    """The content of an input file; raises OSError for a pipe or device, which may never end, and
    for a file that is too large.
    """
    about = path.stat()
    # A folder ends, but cannot be read, which says more.
    is_endless = not (stat.S_ISREG(about.st_mode) or path.is_dir())
    if is_endless or about.st_size > largest:
        problem = f"it is no regular file of at most {largest / 1e6:,.0f} MB"
        raise OSError(errno.EINVAL, problem, str(path))
    return path.read_bytes()


@contextmanager
def whole_file(path: Path, option: str = "") -> Iterator[Path]:
    """Give the path of a temporary file to write, which then replaces `path`; after an error `path`
    is as it was.

    The temporary file lies beside `path` and has the same ending. Those that killed processes have
    left there are removed. A stream such as `/dev/stdout` is given itself. An OSError becomes an
    InputError that names `option`, if it is given.
    """
    # A link stays a link.
    target = Path(os.path.realpath(path))
    is_stream = target.exists() and not target.is_file()
    # File systems limit the length of names.
    short_stem = target.stem[:100]
    file = path
    if not is_stream:
        file = target.with_name(
            f".{short_stem}.{secrets.token_hex(4)}.tmp{target.suffix}"
        )
    try:
        pattern = f".{escape(short_stem)}.????????.tmp{escape(target.suffix)}"
        with nullcontext() if is_stream else _owned(file, file.parent.glob(pattern)):
            yield file
        if not is_stream:
            with open(file, "rb+") as stream:
                os.fsync(stream.fileno())
            os.replace(file, target)
    except BaseException as error:
        if not is_stream:
            file.unlink(missing_ok=True)
        if option and isinstance(error, OSError):
            raise unwritable(path, option, error) from None
        raise


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Give a temporary folder, which ends with the block; those that killed processes have left are
    removed.
    """
    with tempfile.TemporaryDirectory(
        prefix=PREFIX, dir=parent, ignore_cleanup_errors=True
    ) as text:
        folder = Path(text)
        with _owned(folder / LOCK, folder.parent.glob(f"{PREFIX}*/{LOCK}")):
            yield folder


@contextmanager
def _owned(file: Path, neighbours: Iterable[Path]) -> Iterator[None]:
    """Make a temporary file and lock it within the block; remove those of its neighbours that
    nobody has locked.
    """
    with open(file, "xb") as stream:
        # On Windows a lock would keep out this process, too.
        if os.name != "nt":
            for neighbour in neighbours:
                if neighbour != file:
                    _remove_left_behind(neighbour)
            # A disk may have no locks.
            with suppress(portalocker.LockException):
                portalocker.lock(stream, ALONE)
        yield


def _remove_left_behind(file: Path) -> None:
    """Remove a temporary file, of a `LOCK` its folder, that no process has locked, unless it is so
    new that one may be about to.
    """
    with suppress(OSError, portalocker.LockException), open(file, "rb+") as stream:
        portalocker.lock(stream, ALONE)
        if time.time() - os.fstat(stream.fileno()).st_mtime > SETTLING_TIME:
            shutil.rmtree(file.parent) if file.name == LOCK else file.unlink()


def check_writable(
    path: Path, option: str, endings: Sequence[str] = (), but: str = ""
) -> None:
    """Refuse an output file that cannot be written, before the work begins, whose name has another
    ending, or that exists and is named `but`; raises InputError.
    """
    if endings and path.suffix.lower() not in endings:
        raise InputError(option, str(path), f"a file that ends in {', '.join(endings)}")
    if path.name == but and path.exists():
        raise InputError(option, f"{path} holds results", "another file")
    try:
        with (
            path.open("a")
            if path.exists()
            else tempfile.TemporaryFile(dir=path.resolve().parent)
        ):
            pass
    except OSError as error:
        raise unwritable(path, option, error) from None


def unwritable(path: Path, option: str, error: Exception) -> InputError:
    """The error for an output file that cannot be written."""
    return InputError(
        option,
        f"cannot write {path}: {getattr(error, 'strerror', None) or error}",
        WRITABLE,
    )


def file_beside(text: str, folders: Sequence[str]) -> str:
    """The file that a text names, relative to the folder of the study's file or of a file that it
    extends; "" if there is none.
    """
    try:
        return next(
            (
                os.path.abspath(path)
                for folder in folders
                if (path := Path(folder, text)).is_file()
            ),
            "",
        )
    except (OSError, ValueError):
        # The text is no path.
        return ""
