"""What may be read from and written to."""

from __future__ import annotations

from pathlib import Path

from safevar_sumo.errors import InputError

HANDED_ON = ("/dev/stdin", "/dev/stdout", "/dev/stderr", "/dev/null")
HANDLES = ("/dev/fd", "/proc/self/fd")


def refuse_other_than_file(path: Path, source: object = None, *, streams: bool = False) -> None:
    """Refuse what exists and is no regular file: a pipe would be waited for, for ever.

    Parameters
    ----------
    path
        What is to be read or written.
    source
        What the error names; by default the path.
    streams
        Whether what a shell hands on counts as a file, such as `/dev/stdout` and `<(zcat data.csv.gz)`.

    Raises
    ------
    InputError
        If it is something else.
    """
    handed_on = streams and (str(path) in HANDED_ON or str(path.parent) in HANDLES)
    if path.exists() and not path.is_file() and not handed_on:
        told = "is no regular file"
        raise InputError(path if source is None else source, told if source is None else f"{path} {told}", "a file")
