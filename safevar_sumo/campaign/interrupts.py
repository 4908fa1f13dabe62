"""Ctrl-C while a pool works: noted at once, but raised only where the main thread waits for a result and holds no lock.

An interrupt inside `concurrent.futures` may leave a lock behind for which the thread of a worker waits for ever. An
interrupt while a pool closes would leave worker processes behind.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import TypeVar

from safevar_sumo.records import Evaluations

Item = TypeVar("Item")
SECONDS_BETWEEN_CHECKS = 0.2
"""Longest time for which Ctrl-C goes unnoticed [s]."""
_interrupt = threading.Event()


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Raise Ctrl-C only in the functions that wait, and at the end of this context."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _interrupt.clear()
    previous_handler = signal.signal(signal.SIGINT, lambda *_: _interrupt.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if previous_handler is None else previous_handler)
    _raise_pending_interrupt()


@contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Within `defer_interrupts`, treat the signal SIGTERM like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_handler = signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler or signal.SIG_DFL)


def wait_for_first(futures: Iterable[Future[Evaluations]]) -> set[Future[Evaluations]]:
    """Wait until a future is done, and return all futures that are done; an empty set if there are no futures."""
    while True:
        done, waiting_futures = wait(futures, timeout=SECONDS_BETWEEN_CHECKS, return_when=FIRST_COMPLETED)
        _raise_pending_interrupt()
        if done or not waiting_futures:
            return done


def wait_for_result(future: Future[Evaluations]) -> Evaluations:
    """The result of a future, or its error, once the future is done."""
    wait_for_first([future])
    return future.result()


def wait_for_next(queue: SimpleQueue[Item]) -> Item:
    """The next item of a queue that other threads fill."""
    while True:
        _raise_pending_interrupt()
        with suppress(Empty):
            return queue.get(timeout=SECONDS_BETWEEN_CHECKS)


def _raise_pending_interrupt() -> None:
    if _interrupt.is_set():
        _interrupt.clear()
        raise KeyboardInterrupt


def block_interrupts() -> None:
    """Block Ctrl-C in this thread and, because the mask is inherited, in the processes that the thread starts."""
    if sys.platform == "win32":  # Windows has no signal masks; `serve` in local.py ignores interrupts
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # a later start would unblock interrupts
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
