"""Findings of a check, and the time limit of user code."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from types import FrameType
from typing import Any

from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins import Guard
from safevar_sumo.study import Study, user_code_names

ADVICE: Mapping[str, str] = {
    "contract": "return what the base class documents: see `safevar_sumo/{base}` and the tutorials",
    "units": "give the study's table and UNITS the same names and units",
    "determinism": "draw nothing at random (an algorithm: from `rng` alone) and do not read the clock",
    "state": "keep what a vehicle remembers in the memory that is handed on, or in the instance of that vehicle: nothing in a class, a "
             "module or a model from one run to the next",
    "batch": "compute element i of a result from element i of the arguments alone: no mean, sum or maximum over the vehicles, no place in "
             "the batch",
    "inputs": "work on a copy: `values = values.copy()`, or make a new array",
    "finite": "guard divisions and roots where the domain ends: `np.maximum(value, smallest)`; infinite gaps mean that nobody is in sight",
    "reaction": "check that the code reads the quantity that it should react to, with the right sign and unit",
    "speed": "compute all vehicles at once with arrays; load files in `__init__`",
    "picklable": "give functions a name at the top of the module; open files, sockets and locks in `start`, not in `__init__`",
}
"""Advice by check."""
BLOCKING_CHECKS = ("contract", "units", "determinism", "state", "batch", "inputs", "finite")
"""Checks whose failure makes results wrong: the study does not begin. A failure of any other check is a warning."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A failed check, with the line at fault, the expected and the actual result, and advice."""

    check: str
    file: str
    line: int
    expected: str
    got: str
    advice: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.check}: {self.got}"


@dataclass(kw_only=True)
class Report:
    """The findings on a subject; `key` is its key and name in a study, `remarks` state assumptions, `speed` is a sentence."""

    subject: str
    kind: str
    key: str = ""
    findings: list[Finding] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    speed: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return not self.findings

    def to_dict(self) -> dict[str, Any]:
        """The JSON output of the command `check`."""
        return {"subject": self.subject, "kind": self.kind, "passed": self.passed, "findings": list(map(asdict, self.findings)),
                "seconds": round(self.seconds, 3)}


class UserCodeTimeout(BaseException):
    """User code exceeds its time limit. It is raised inside that code, which may catch every `Exception`; hence it is none."""


def load_factor() -> float:
    """The factor by which other processes slow this one down: the number of runnable processes per core, at least 1."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 1.0
    return max(1.0, load / (os.cpu_count() or 1))


TICKS = 10
"""Number of intervals into which a time limit is divided; an interval that ends during an import does not count."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `UserCodeTimeout` in a block that would take longer than `seconds` on an idle machine.

    The import of modules does not count, nor time in a debugger. The limit has no effect outside the main thread, on Windows, and where the
    caller has set an alarm of its own.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or not hasattr(signal, "setitimer") or signal.getitimer(signal.ITIMER_REAL)[0]:
        yield
        return
    ticks_left = TICKS

    def tick(_: int, frame: FrameType | None) -> None:
        nonlocal ticks_left
        while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
            frame = frame.f_back
        ticks_left -= frame is None and sys.gettrace() is None
        if not ticks_left:
            raise UserCodeTimeout

    previous_handler = signal.signal(signal.SIGALRM, tick)
    interval = seconds * load_factor() / TICKS
    signal.setitimer(signal.ITIMER_REAL, interval, interval)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous_handler)


@contextmanager
def limit_user_code(study: Study) -> Iterator[None]:
    """Give the user code of a study, if any, as much time in a block as a batch of a search has, where `time_limit` has an effect.

    Raises
    ------
    UserCodeError
        With the line at which the user code was interrupted.
    """
    if not (names := user_code_names(study)):
        yield
        return
    try:
        with time_limit(study.search.time_limit):
            yield
    except UserCodeTimeout as error:
        source, code = study.source, " and ".join(names)
        problem = f"{code}: the simulation took longer than {study.search.time_limit:g} s ({Guard(source, code).location(error)})"
        raise UserCodeError(source, problem, "code that returns, or a longer search.time_limit") from None
