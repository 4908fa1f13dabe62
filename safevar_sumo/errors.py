"""Errors that a user can mend: one or two lines, never a traceback."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it: 128 and the signal's number."""


class SafevarError(Exception):
    """A failure that is not a bug of this package; the command ends with `exit_code`."""

    exit_code = 1


class InputError(SafevarError):
    """A value that the user gave and that cannot be used.

    Parameters
    ----------
    source
        Where the value stands: a file, a flag or a command's argument.
    problem
        The key and the value, and what is wrong with them.
    legal
        What would be right.
    """

    exit_code = 2

    def __init__(self, source: object, problem: str, legal: str = "") -> None:
        self.source, self.problem, self.legal = source, problem, legal
        super().__init__(source, problem, legal)

    def __str__(self) -> str:
        message = f"{self.source}: {self.problem}"
        return f"{message}\nexpected: {self.legal}" if self.legal else message


class ForeignError(InputError):
    """Code from outside the package, which a study names, failed or returned what it must not."""


class SimulationError(SafevarError):
    """SUMO failed while a simulation ran."""


class EnvironmentFault(SafevarError):
    """What a simulation needs beside its setting failed: a disk, memory, netconvert, SUMO's start."""


def warn(message: str) -> None:
    """Warn with the line that called this package: its author can do something about it."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == __name__.partition(".")[0]:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def first_line(error: BaseException) -> str:
    """The class of an error and the first line of its message, even if `str(error)` fails."""
    try:
        lines = str(error).strip().splitlines()
    except Exception:
        lines = []
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def unknown(source: object, problem: str, given: object, names: Iterable[str], otherwise: str = "") -> InputError:
    """The error for a name that there is not: it asks whether the nearest one is meant, and lists all of them.

    Parameters
    ----------
    source, problem
        As those of `InputError`.
    given
        The name that the user gave.
    names
        The names that there are.
    otherwise
        What would be right beside the names.
    """
    options = list(names)
    return InputError(source, f"{problem}{did_you_mean(given, options)}", f"{one_of(options)}{otherwise}")


def did_you_mean(given: object, names: Iterable[str]) -> str:
    """`; did you mean 'rain'?`, or nothing where no name is near what was given; upper and lower case are near."""
    by_lower = {name.lower(): name for name in names}
    near = get_close_matches(str(given).lower(), by_lower, n=1)
    return f"; did you mean {by_lower[near[0]]!r}?" if near else ""


def one_of(names: Iterable[str]) -> str:
    """List the legal names of a choice for an error message."""
    return "one of " + ", ".join(sorted(names))


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
        problem = "is no regular file but a directory" if path.is_dir() else "is no regular file"
        raise InputError(path if source is None else source, problem if source is None else f"{path} {problem}", "a file")
