"""What a pool of workers does: it computes batches for questions, and carries shares of a study's runs.

Ctrl-C while a pool works is noted at once, but raised only where the main thread waits for a result and holds no lock.
An interrupt inside `concurrent.futures` may leave a lock behind for which the thread of a worker waits for ever; an
interrupt while a pool closes would leave worker processes behind.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol, TypeVar

from safevar_sumo.errors import SafevarError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import Failure, run_name

Item = TypeVar("Item")
SECONDS_BETWEEN_CHECKS = 0.2
"""Longest time for which Ctrl-C goes unnoticed [s]."""
_interrupt = threading.Event()


class WorkerLostError(SafevarError):
    """The process that computed a batch died, or exceeded the time limit and ended itself."""


class PoolLostError(SafevarError):
    """The pool cannot compute any more batches."""


class RunKey(NamedTuple):
    """One run of an algorithm; the number `run` counts from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return run_name(self.algorithm, self.run)


class Share(NamedTuple):
    """A share of a study's runs, which one worker carries out.

    Attributes
    ----------
    work
        The packed study, whose batches have at most `batch` settings of several runs.
    sumo_work, recorded_work
        Packed studies that verify results in SUMO; `sumo_work` is empty if SUMO simulates everything anyway,
        `recorded_work` if the results of the runs are comparable themselves.
    keys
        The runs.
    directory, identity
        The directory of the journals, which the worker must see, and the digest of the study's identity.
    original
        The original vehicle's evaluation.
    retry_failed
        Whether settings are simulated again that failed before.
    deaths
        Why a worker died, for each attempt in the round of batches in which an earlier worker died with this share; by
        setting, or b"" for a batch of several settings.
    """

    work: bytes
    sumo_work: bytes
    recorded_work: bytes
    batch: int
    keys: tuple[RunKey, ...]
    directory: Path
    identity: str
    original: Evaluations
    retry_failed: bool
    deaths: Mapping[bytes, tuple[str, ...]] = {}


class RunProgress(NamedTuple):
    """The state of a run.

    Attributes
    ----------
    asked
        Number of requested evaluations.
    replayed
        Number of requested evaluations that the journal held when the worker began.
    collisions
        Number of distinct settings that collided.
    best
        The lowest safety degree [m or -m/s]; None before the first valid evaluation.
    """

    key: RunKey
    asked: int
    replayed: int
    collisions: int
    best: float | None


class RunResult(NamedTuple):
    """A finished run: its state, its solutions, settings that could not be simulated, and the number of invalid
    tests.
    """

    progress: RunProgress
    solutions: Evaluations
    failures: list[Failure]
    invalid_tests: int


Message = bytes | list[RunProgress] | RunResult | RunKey | str
"""What a worker reports of its share: the setting that it begins to simulate, b"" for several; the state of all runs
after a round of batches; a result; a run that another process carries out; or a warning.
"""
Report = Callable[[Message], None]


class Pool(Protocol):
    """Workers; a future may fail with `WorkerLostError`, `PoolLostError` or an error of its batch or share."""

    @property
    def workers(self) -> int:
        """Number of batches or shares that are computed at the same time."""

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        """Evaluate k filtered settings of n characteristics, shape (k, n), of a packed study."""

    def carry(self, share: Share, report: Report) -> Future[None]:
        """Carry out a share of a study's runs; `report` is called with every message, and ends the share by an
        exception.
        """


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
