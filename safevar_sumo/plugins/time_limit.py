"""The time limit of a simulation, and of the import and the `__init__` of user code. Code that
takes longer counts as hung.

A worker that exceeds the limit ends, and its pool reports the line at which it was. In any other
process, the limit raises an error, if the system has timers.
"""

from __future__ import annotations

import faulthandler
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import IO

from safevar_sumo.errors import SimulationError, UserCodeError, in_main_thread
from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.plugins.process import Interrupt, this_process

TIMEOUT_MARK = "Timeout ("
"""The beginning of the text that Python writes when a process exceeds its time limit."""


class _TimeIsUp(Interrupt):
    """The exception at the end of the time. Like Ctrl-C, it passes through user code. Its argument
    is the error for the user.
    """


@contextmanager
def end_if_longer(time_limit: float, name: str = "a simulation") -> Iterator[None]:
    """Limit the time of a block [s]. After the limit, a worker ends. In the main thread of any
    other process, an error is raised, with the `name` of the block. A limit within the block has no
    effect.

    Raises
    ------
    UserCodeError
        If user code took too long; the error has the line.
    SimulationError
        If other code took too long.
    """
    has_timer = hasattr(signal, "setitimer") and in_main_thread()
    words = this_process.last_words
    if this_process.is_limited or not (has_timer or words is not None):
        yield
        return
    this_process.is_limited = True
    try:
        with (
            _raise_error(time_limit, name)
            if words is None
            else _end_process(time_limit, words)
        ):
            yield
    finally:
        this_process.is_limited = False


@contextmanager
def _end_process(time_limit: float, last_words: IO[str]) -> Iterator[None]:
    """Let Python end this process after the time limit, and write its line to `last_words`."""
    faulthandler.dump_traceback_later(time_limit, exit=True, file=last_words)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def _raise_error(time_limit: float, name: str) -> Iterator[None]:
    """Let a timer raise an error in this process after the time limit."""

    def refuse(_signal: int, frame: FrameType | None) -> None:
        problem = f"{name} took longer than the time limit of {time_limit:g} s"
        while frame is not None:
            if is_user_file(frame.f_code.co_filename):
                place = f"{frame.f_code.co_filename}:{frame.f_lineno}"
                legal = "code that ends, or more time"
                raise _TimeIsUp(
                    UserCodeError(
                        "search.time_limit", f"{problem} ({place})", legal, place
                    )
                )
            frame = frame.f_back
        raise _TimeIsUp(SimulationError(f"{problem}, search.time_limit"))

    previous_handler = signal.signal(signal.SIGALRM, refuse)
    previous_timer = signal.setitimer(signal.ITIMER_REAL, time_limit)
    try:
        yield
    except _TimeIsUp as end:
        raise end.args[0] from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, *previous_timer)
        signal.signal(signal.SIGALRM, previous_handler)
