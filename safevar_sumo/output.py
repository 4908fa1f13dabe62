"""Files that users name: input files, output files (which are written as a whole or not at all),
and files beside a study. Also temporary files and folders, which are removed even after a kill.
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
"""Time within which a process locks a temporary file that it has created [s]."""
PREFIX = "safevar-"
"""Beginning of the names of temporary folders."""
LOCK = "lock"
"""Name of the file in a temporary folder that the folder's process has locked."""
MAX_INPUT = 100_000_000
"""Largest size of an input file [bytes]."""
MAX_UNPACKED = 1_000_000_000
"""Largest size of all files of an archive together, unpacked [bytes]."""
WRITABLE = "a file in a directory that can be written, with space for it"
"""The expected value in an error about an output file."""


def read_file(path: Path, largest: int = MAX_INPUT) -> bytes:
    """Read an input file. Raise an OSError for a file that is too large, and for a pipe or device,
    which may never end.
    """
    about = path.stat()
    # A folder is no regular file, either, but reading it raises an error that says more.
    is_endless = not (stat.S_ISREG(about.st_mode) or path.is_dir())
    if is_endless or about.st_size > largest:
        problem = f"it is no regular file of at most {largest / 1e6:,.0f} MB"
        raise OSError(errno.EINVAL, problem, str(path))
    return path.read_bytes()


@contextmanager
def whole_file(path: Path, option: str = "") -> Iterator[Path]:
    """Give the path of a temporary file. After the block, this file replaces `path`. After an
    error, `path` is unchanged.

    The temporary file is beside `path`, and has the same ending. Temporary files that killed
    processes have left there are removed. If `path` is a stream such as `/dev/stdout`, the block
    gets the stream itself. An OSError becomes an InputError that names `option`, if an option is
    given.
    """
    # If `path` is a link, its target is replaced, and the link stays.
    target = Path(os.path.realpath(path))
    is_stream = target.exists() and not target.is_file()
    # File systems limit the length of names: a long name would not leave space for the suffix.
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
    """Give a temporary folder, which is removed after the block. Folders that killed processes have
    left are removed, too.
    """
    with tempfile.TemporaryDirectory(
        prefix=PREFIX, dir=parent, ignore_cleanup_errors=True
    ) as text:
        folder = Path(text)
        with _owned(folder / LOCK, folder.parent.glob(f"{PREFIX}*/{LOCK}")):
            yield folder


@contextmanager
def _owned(file: Path, neighbours: Iterable[Path]) -> Iterator[None]:
    """Create a temporary file, and lock it within the block. Remove the neighbours that no process
    has locked: their processes were killed.
    """
    with open(file, "xb") as stream:
        # On Windows, a lock would also prevent this process from writing.
        if os.name != "nt":
            for neighbour in neighbours:
                if neighbour != file:
                    _remove_left_behind(neighbour)
            # Some file systems have no locks: the file is then used without a lock.
            with suppress(portalocker.LockException):
                portalocker.lock(stream, ALONE)
        yield


def _remove_left_behind(file: Path) -> None:
    """Remove a temporary file that no process has locked, or, for the file `LOCK`, its folder. A
    new file stays, because its process may not have locked it yet.
    """
    with suppress(OSError, portalocker.LockException), open(file, "rb+") as stream:
        portalocker.lock(stream, ALONE)
        if time.time() - os.fstat(stream.fileno()).st_mtime > SETTLING_TIME:
            shutil.rmtree(file.parent) if file.name == LOCK else file.unlink()


def check_writable(
    path: Path, option: str, endings: Sequence[str] = (), but: str = ""
) -> None:
    """Refuse an output file, by an InputError, before the work begins. The file must be writable,
    and end in one of `endings`. An existing file with the name `but` must not be overwritten.
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
    """The error that an output file cannot be written."""
    return InputError(
        option,
        f"cannot write {path}: {getattr(error, 'strerror', None) or error}",
        WRITABLE,
    )


def file_beside(text: str, folders: Sequence[str]) -> str:
    """The path of the file that a text names, relative to one of the `folders`; "" if no such file
    exists.
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
        # A text that is no legal path names no file.
        return ""
