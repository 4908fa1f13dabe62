"""Ctrl-C while a pool works: noted at once, raised where the main thread waits for a result, never while a lock is held.

An interrupt anywhere inside `concurrent.futures` may leave a lock behind that a worker's thread then waits for, for ever,
and one while a pool is closed would leave workers behind.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager

from safevar_sumo.records import Evaluations

SECONDS_BETWEEN_LOOKS = 0.2
"""Longest time for which Ctrl-C goes unnoticed [s]."""
_pressed = threading.Event()


@contextmanager
def interrupts_noted() -> Iterator[None]:
    """Within the context only `first_of` and `result_of` raise Ctrl-C; one that is still pending is raised at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _pressed.clear()
    before = signal.signal(signal.SIGINT, lambda *_: _pressed.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if before is None else before)
    _raise_if_pressed()


def first_of(futures: Iterable[Future[Evaluations]]) -> set[Future[Evaluations]]:
    """Wait until a future is done, and return all that are; an empty set if there are no futures."""
    while True:
        done, not_done = wait(futures, timeout=SECONDS_BETWEEN_LOOKS, return_when=FIRST_COMPLETED)
        _raise_if_pressed()
        if done or not not_done:
            return done


def awaited(future: Future[Evaluations]) -> Evaluations:
    """Wait for a future's result; raises its error."""
    first_of([future])
    return future.result()


def _raise_if_pressed() -> None:
    if _pressed.is_set():
        _pressed.clear()
        raise KeyboardInterrupt


def leave_interrupts_to_the_caller() -> None:
    """Block Ctrl-C, which reaches all processes of a terminal, in this thread: processes that it starts then never see it."""
    if sys.platform == "win32":  # there are no signal masks: a process ignores interrupts once it serves
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its start would unblock interrupts
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
