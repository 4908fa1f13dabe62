"""Ctrl-C while futures are waited for."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager

from safevar_sumo.records import Evaluations

SECONDS_BETWEEN_LOOKS = 0.2
"""How long Ctrl-C may go unnoticed at the most."""


@contextmanager
def interrupts_between_waits() -> Iterator[Callable[[Iterable[Future[Evaluations]]], set[Future[Evaluations]]]]:
    """Yields how to wait for the first of some futures; Ctrl-C is raised there, never while a future's lock is held.

    An interrupt inside `concurrent.futures` may leave a lock behind that the worker's thread then waits for, for ever.
    """
    pressed = False

    def note(*_: object) -> None:
        nonlocal pressed
        pressed = True

    def first_of(futures: Iterable[Future[Evaluations]]) -> set[Future[Evaluations]]:
        while True:
            done, not_done = wait(futures, timeout=SECONDS_BETWEEN_LOOKS, return_when=FIRST_COMPLETED)
            if pressed:
                raise KeyboardInterrupt
            if done or not not_done:
                return done

    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, note) if in_main_thread else None
    try:
        yield first_of
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, before)
