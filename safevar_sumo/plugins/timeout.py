"""The time limit of user code that runs in the main process."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins.guard import Guard
from safevar_sumo.study import Study, user_code_names


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
