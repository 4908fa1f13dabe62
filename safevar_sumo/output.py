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
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from glob import escape
from pathlib import Path
from typing import IO

import portalocker

from safevar_sumo.errors import InputError

ALONE = portalocker.LOCK_EX | portalocker.LOCK_NB
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
    try:
        with nullcontext(path) if is_stream else _replacement(target) as file:
            yield file
    except OSError as error:
        if option:
            raise unwritable(path, option, error) from None
        raise


@contextmanager
def _replacement(target: Path) -> Iterator[Path]:
    """Give the path of a temporary file that replaces the file `target` after the block."""
    # File systems limit the length of names: a long name would not leave space for the suffix.
    short_stem = target.stem[:100]
    pattern = f".{escape(short_stem)}.????????.tmp{escape(target.suffix)}"
    _remove_left_behind(target.parent.glob(pattern))
    lock = None
    while lock is None:
        file = target.with_name(
            f".{short_stem}.{secrets.token_hex(4)}.tmp{target.suffix}"
        )
        lock = _create_locked(file)
    try:
        with lock:
            yield file
            with open(file, "rb+") as stream:
                os.fsync(stream.fileno())
            # Without the lock, another process would remove the file before it replaces `target`.
            # Windows, which has no such lock, does not rename a file that is open.
            if os.name == "nt":
                lock.close()
            os.replace(file, target)
    except BaseException:
        file.unlink(missing_ok=True)
        raise


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Give a temporary folder, which is removed after the block. Folders that killed processes have
    left are removed, too.
    """
    place = parent or Path(tempfile.gettempdir())
    _remove_left_behind(place.glob(f"{PREFIX}*/{LOCK}"))
    with ExitStack() as stack:
        lock = None
        while lock is None:
            new_folder = tempfile.TemporaryDirectory(
                prefix=PREFIX, dir=place, ignore_cleanup_errors=True
            )
            folder = Path(stack.enter_context(new_folder))
            lock = _create_locked(folder / LOCK)
        stack.enter_context(lock)
        yield folder


def _create_locked(file: Path) -> IO[bytes] | None:
    """Create a temporary file, and lock it until it is closed. None if another process removed the
    file before it was locked, because it looked like a file that a killed process has left.
    """
    stream = open(file, "xb")  # noqa: SIM115 - the caller closes it
    # On Windows, a lock would also prevent this process from writing.
    if os.name != "nt":
        # This process waits for the lock while another process removes the file. Some file systems
        # have no locks: the file is then used without a lock, and no process removes it.
        with suppress(portalocker.LockException):
            portalocker.lock(stream, portalocker.LOCK_EX)
        if not file.exists():
            stream.close()
            return None
    return stream


def _remove_left_behind(files: Iterable[Path]) -> None:
    """Remove temporary files that no process has locked, because their processes were killed. If
    such a file has the name `LOCK`, its folder is removed.
    """
    # On Windows, no process locks its temporary files.
    if os.name == "nt":
        return
    for file in files:
        with suppress(OSError, portalocker.LockException), open(file, "rb+") as stream:
            portalocker.lock(stream, ALONE)
            if file.name == LOCK:
                shutil.rmtree(file.parent)
            else:
                file.unlink()


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
        for folder in folders:
            path = Path(folder, text)
            if path.is_file():
                return os.path.abspath(path)
    except (OSError, ValueError):
        # A text that is no legal path names no file.
        return ""
    return ""
