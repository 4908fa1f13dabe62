"""Errors that a user can fix: one or two lines, never a traceback."""

from __future__ import annotations

import inspect
import re
import signal
import warnings
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from difflib import get_close_matches
from os import PathLike
from typing import Any

MAX_JOBS = 1024
"""Largest number of worker processes."""
INTERRUPT_EXIT_CODE = 130
"""Exit code after Ctrl-C, as in shells: 128 plus the signal's number."""
INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end the program as Ctrl-C does."""
CONTROLS = re.compile(
    r"[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Characters that steer a terminal or hide text, and halves of characters."""


def printable(text: str) -> str:
    """A text of users and their code as every output has it: a question mark for each control
    character but a tab and the end of a line.
    """
    return CONTROLS.sub("?", text)


_subject: ContextVar[str] = ContextVar("subject", default="study")
"""What the code that runs now is about: a study, a file or a command's argument, as errors name it.
"""


def subject() -> str:
    """The study, file or argument that the code that runs now is about."""
    return _subject.get()


@contextmanager
def about(source: object) -> Iterator[None]:
    """Within the block, errors without a source of their own are about this one."""
    token = _subject.set(str(source))
    try:
        yield
    finally:
        _subject.reset(token)


class SafevarError(Exception):
    """A failure that is no bug of this package; a command that raises it ends with `exit_code`."""

    exit_code = 1


class InputError(SafevarError):
    """The user gave a value that this package cannot use.

    Parameters
    ----------
    source
        Where the value comes from: a file, a flag or a command's argument; "" for what the code
        that runs now is about.
    problem
        The key and the value, and what is wrong with them.
    legal
        The expected values.
    """

    exit_code = 2

    def __init__(self, source: object, problem: str, legal: str = "") -> None:
        self.source = source or subject()
        # A user's text may have lone surrogates.
        self.problem = problem.encode(errors="backslashreplace").decode()
        self.legal = legal
        super().__init__(self.source, self.problem, legal)

    def __str__(self) -> str:
        message = f"{self.source}: {self.problem}"
        if self.legal:
            return f"{message}\nexpected: {self.legal}"
        return message


def missing_extra(source: object, problem: str, extra: str) -> InputError:
    """The error that an extra of this package is not installed."""
    return InputError(source, problem, f"in the checkout: pip install '.[{extra}]'")


class UserCodeError(InputError):
    """User code that a study names failed or returned an illegal value; `place` is its file and
    line, "" if they are unknown.
    """

    def __init__(
        self, source: object, problem: str, legal: str = "", place: str = ""
    ) -> None:
        super().__init__(source, problem, legal)
        self.place = place


class SimulationError(SafevarError):
    """SUMO failed while a simulation ran."""


class EnvironmentFault(SafevarError):
    """A simulation failed for a reason outside its setting: a disk, memory, netconvert, SUMO's
    start.
    """


def warn(message: str) -> None:
    """Warn, and name the line of user code that called this package."""
    frame = inspect.currentframe()
    level = 1
    while (
        frame is not None
        and str(frame.f_globals.get("__name__")).partition(".")[0]
        == __name__.partition(".")[0]
    ):
        frame = frame.f_back
        level += 1
    warnings.warn(message, stacklevel=level)


MAX_MESSAGE_LENGTH = 500
"""Length at which an error cuts a message that it quotes [characters]."""


def describe_error(error: BaseException) -> str:
    """Describe an error by its class and its message, cut at `MAX_MESSAGE_LENGTH`, even if
    `str(error)` fails.
    """
    try:
        message = " ".join(str(error).split())
    except Exception:
        message = ""
    if len(message) > MAX_MESSAGE_LENGTH:
        message = f"{message[:MAX_MESSAGE_LENGTH]}..."
    if message:
        return f"{type(error).__name__}: {message}"
    return type(error).__name__


def unknown_name(
    source: object,
    problem: str,
    name: object,
    names: Iterable[str],
    otherwise: str = "",
) -> InputError:
    """Make the error for an unknown name: it suggests the nearest known name, and lists all known
    names.

    Parameters
    ----------
    source, problem
        As in `InputError`.
    name
        The name that the user gave.
    names
        The known names.
    otherwise
        What is accepted besides the names.
    """
    known_names = list(names)
    return InputError(
        source,
        f"{problem}{did_you_mean(name, known_names)}",
        f"{one_of(known_names)}{otherwise}",
    )


def check_text(argument: str, value: Any) -> Any:
    """The value of an argument, which has to be a text or a path; raises an InputError."""
    if not isinstance(value, str | PathLike):
        raise InputError(argument, repr(value), "a text or a path")
    return value


def check_name(
    source: object,
    problem: str,
    name: object,
    names: Collection[str],
    otherwise: str = "",
) -> None:
    """Refuse a name that is not known; raises the error of `unknown_name`."""
    if name not in names:
        raise unknown_name(source, problem, name, names, otherwise)


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """The text `; did you mean 'rain'?` with the name nearest in spelling, ignoring case; empty if
    no name is similar.
    """
    names_in_lower_case = {known_name.lower(): known_name for known_name in names}
    matches = get_close_matches(str(name).lower(), names_in_lower_case, n=1)
    if matches:
        return f"; did you mean {names_in_lower_case[matches[0]]!r}?"
    return ""


def one_of(names: Iterable[str]) -> str:
    """The text `one of`, with all legal names, for an error message; `none` without any."""
    listed = ", ".join(sorted(names))
    if listed:
        return f"one of {listed}"
    return "none"
