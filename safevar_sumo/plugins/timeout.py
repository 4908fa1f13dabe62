"""The time limit of user code that runs in the main process."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins.files import audit_hook
from safevar_sumo.plugins.guard import Guard
from safevar_sumo.study import Study, user_code_names


class UserCodeTimeout(BaseException):
    """User code exceeds its time limit. It is raised inside that code, which may catch every `Exception`; hence it is none."""


MAX_LOAD_FACTOR = 10.0
"""Largest `load_factor`: on a busier machine the load of the last minute tells little of the next."""


def load_factor() -> float:
    """The factor by which other processes slow this one down: the number of runnable processes per core, at least 1."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 1.0
    return min(max(1.0, load / (os.cpu_count() or 1)), MAX_LOAD_FACTOR)


TICKS = 10
"""Number of intervals into which a time limit is divided; an interval that ends during an import does not count."""
DEBUGGERS = ("bdb", "pdb", "pydevd")
"""Parts of the names of modules whose trace functions are debuggers', not those of tools such as coverage."""


@contextmanager
def time_limit(seconds: float, counts: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Raise `UserCodeTimeout` in a block that would take longer than `seconds` on an idle machine, and again if the block goes on.

    The import of modules does not count, nor time in a debugger or while `counts` returns False. The limit has no effect outside the main
    thread, on Windows, where the caller has set an alarm of its own, and once the block sets one.
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
        ticks_left -= frame is None and counts() and not _is_in_debugger()
        if ticks_left <= 0:
            raise UserCodeTimeout

    previous_handler = signal.signal(signal.SIGALRM, tick)
    interval = seconds * load_factor() / TICKS
    signal.setitimer(signal.ITIMER_REAL, interval, interval)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous_handler)


def _is_in_debugger() -> bool:
    trace = sys.gettrace()
    module = getattr(trace, "__module__", None) or type(trace).__module__
    return trace is not None and any(name in module for name in DEBUGGERS)


@contextmanager
def limit_user_code(study: Study) -> Iterator[None]:
    """Give the user code of a study, if any, as much time in a block as a batch of a search has, where `time_limit` has an effect.

    Time that the package spends by itself does not count.

    Raises
    ------
    UserCodeError
        With the line at which the user code was interrupted.
    """
    if not (names := user_code_names(study)):
        yield
        return
    try:
        with time_limit(study.search.time_limit, counts=lambda: audit_hook.call_depth > 0):
            yield
    except UserCodeTimeout as error:
        source, code = study.source, " and ".join(names)
        problem = f"{code}: the simulation took longer than {study.search.time_limit:g} s ({Guard(source, code).location(error)})"
        raise UserCodeError(source, problem, "code that returns, or a longer search.time_limit") from None
