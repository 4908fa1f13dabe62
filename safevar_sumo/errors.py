"""Errors that a user can fix. A user sees one or two lines, never a traceback."""

from __future__ import annotations

import inspect
import re
import signal
import threading
import warnings
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from difflib import get_close_matches
from os import PathLike
from types import FrameType
from typing import Any

MAX_JOBS = 1024
"""Largest number of worker processes: more than any machine has cores, so that a larger number is a
slip of the pen.
"""
INTERRUPT_EXIT_CODE = 130
"""Exit code after Ctrl-C: 128 plus the number of the signal, as in shells."""
INTERRUPTS = tuple(
    signal.Signals[name]
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
    if name in signal.Signals.__members__
)
"""Signals that end the program like Ctrl-C: those of the keyboard and of a lost terminal, and those
with which batch systems announce the end of a job. Windows has the first two alone.
"""


def in_main_thread() -> bool:
    """Whether this is the main thread, which alone may set handlers of signals."""
    return threading.current_thread() is threading.main_thread()


def settable_interrupts() -> tuple[signal.Signals, ...]:
    """The signals of `INTERRUPTS` whose handlers this thread may set; none in other threads than
    the main thread.
    """
    if in_main_thread():
        return INTERRUPTS
    return ()


CONTROLS = re.compile(
    r"[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Characters that control a terminal or hide text, and lone halves of characters."""


def printable(text: str) -> str:
    """Make a text from users or their code printable: each control character becomes a question
    mark, except tabs and ends of lines.
    """
    return CONTROLS.sub("?", text)


_subject: ContextVar[str] = ContextVar("subject", default="study")
"""The name of what the running code is about, for errors: a study, a file, or an argument of a
command.
"""


def subject() -> str:
    """The study, the file or the argument that the running code is about."""
    return _subject.get()


@contextmanager
def about(source: object) -> Iterator[None]:
    """Within the block, errors that do not state a source are about this source."""
    token = _subject.set(str(source))
    try:
        yield
    finally:
        _subject.reset(token)


class SafevarError(Exception):
    """A failure that is no bug of this package. A command with this failure ends with
    `exit_code`.
    """

    exit_code = 1


class InputError(SafevarError):
    """The user gave a value that this package cannot use.

    Parameters
    ----------
    source
        Where the value comes from: a file, a flag or an argument of a command. "" means
        `subject()`.
    problem
        The key and the value, and what is wrong with them.
    legal
        The expected values.
    """

    exit_code = 2

    def __init__(self, source: object, problem: str, legal: str = "") -> None:
        self.source = source or subject()
        # A lone half of a character could not be printed.
        self.problem = problem.encode(errors="backslashreplace").decode()
        self.legal = legal
        super().__init__(self.source, self.problem, legal)

    def __str__(self) -> str:
        message = f"{self.source}: {self.problem}"
        if self.legal:
            return f"{message}\nexpected: {self.legal}"
        return message


def missing_extra(source: object, problem: str, extra: str) -> InputError:
    """The error that a library is missing, because an extra of this package is not installed."""
    return InputError(source, problem, f"in the checkout: pip install '.[{extra}]'")


class UserCodeError(InputError):
    """User code that a study names failed, or returned an illegal value. `place` is the file and
    line of the user code; "" if they are unknown.
    """

    def __init__(
        self, source: object, problem: str, legal: str = "", place: str = ""
    ) -> None:
        super().__init__(source, problem, legal)
        self.place = place


class SimulationError(SafevarError):
    """SUMO failed while a simulation ran."""


class NobodyMoved(SafevarError):
    """No changed vehicle moved in any simulation of a question, so that no verdict is possible."""


class EnvironmentFault(SafevarError):
    """A simulation failed for a reason other than its setting: a disk, memory, netconvert, or the
    start of SUMO.
    """


class Hint(UserWarning):
    """A message about another way to a result, or about the time until it: nothing is wrong."""


def hint(message: str) -> None:
    """Show a hint. The program prints it as a note."""
    warn(message, Hint)


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Show a warning that names the line of user code that called this package."""
    frame = inspect.currentframe()
    level = 1
    while frame is not None and _is_of_package(frame):
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)


def _is_of_package(frame: FrameType) -> bool:
    """Whether a call runs code of this package."""
    package, _, _ = __name__.partition(".")
    caller, _, _ = str(frame.f_globals.get("__name__")).partition(".")
    return caller == package


MAX_MESSAGE_LENGTH = 500
"""Length at which an error cuts off a message that it quotes [characters]."""


def describe_error(error: BaseException) -> str:
    """Describe an error by its class and its message. The message is cut off at
    `MAX_MESSAGE_LENGTH`, and left out if `str(error)` fails.
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
    """Return the value of an argument that must be a text or a path; raise an InputError
    otherwise.
    """
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
    """Refuse an unknown name, with the error of `unknown_name`."""
    if name not in names:
        raise unknown_name(source, problem, name, names, otherwise)


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """The text `; did you mean 'rain'?` with the name of the most similar spelling. "" if no name
    is similar. Upper and lower case do not matter.
    """
    names_in_lower_case = {known_name.lower(): known_name for known_name in names}
    matches = get_close_matches(str(name).lower(), names_in_lower_case, n=1)
    if matches:
        return f"; did you mean {names_in_lower_case[matches[0]]!r}?"
    return ""


def one_of(names: Iterable[str]) -> str:
    """The text `one of` with all legal names, for an error; `none` if no name is legal."""
    text = ", ".join(sorted(names))
    if text:
        return f"one of {text}"
    return "none"
