"""Output files: written as a whole or not at all, and checked before the work begins."""

from __future__ import annotations

import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safevar_sumo.errors import InputError, refuse_other_than_file

WRITABLE = "a file in a directory that can be written, with space for it"
"""What an error about an output file expects."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give the path of a temporary file to write, which then replaces `path`; after an error `path` is as it was.

    The temporary file lies beside `path` and has the same ending. A stream such as `/dev/stdout` is given itself.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    target = Path(os.path.realpath(path))  # a link stays a link
    temporary_file = target.with_name(f".{target.stem[:100]}.{secrets.token_hex(4)}.tmp{target.suffix}")
    try:
        yield temporary_file
        with open(temporary_file, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary_file, target)
    except BaseException:
        temporary_file.unlink(missing_ok=True)
        raise


def check_writable(path: Path, source: str = "out") -> None:
    """Refuse an output file that cannot be written, before the work begins.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    try:
        refuse_other_than_file(path, source, streams=True)
        is_new = not path.exists()
        with path.open("a"):
            pass
        if path.is_file():
            with tempfile.TemporaryFile(dir=Path(os.path.realpath(path)).parent):
                pass
        if is_new:
            path.unlink()
    except OSError as error:
        raise unwritable(path, source, error) from None


def unwritable(path: Path, source: str, error: Exception) -> InputError:
    """The error for an output file that cannot be written."""
    return InputError(source, f"cannot write {path}: {getattr(error, 'strerror', None) or error}", WRITABLE)
