"""A pool of workers, and the loop that carries jobs out although workers die.

One word, one meaning, in this folder:

- a task is what is computed with every setting of a study: the study, the engine, a selection of points (`Task`); it
  travels packed, as bytes;
- a batch is settings that are evaluated together with one task;
- a run is one search of a study, by an algorithm and a number, and a share is the runs that one worker carries out;
- a job is what a pool gives to a worker: a batch for a question, or a share of a study's runs;
- a message is what the worker reports of its job.

Ctrl-C while a pool works is noted at once, but raised only where the main thread waits for a message and holds no lock.
An interrupt inside `concurrent.futures` may leave a lock behind for which the thread of a worker waits for ever; an
interrupt while a pool closes would leave worker processes behind.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from safevar_sumo.campaign.run import RunKey, RunProgress, RunResult
from safevar_sumo.errors import SafevarError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

Item = TypeVar("Item")
SECONDS_BETWEEN_CHECKS = 0.2
"""Longest time for which Ctrl-C goes unnoticed [s]."""
MAX_LOSSES = 2
"""Number of workers in a row that may die of a job outside of its attempts: another process may have killed them."""
_interrupt = threading.Event()


class WorkerLostError(SafevarError):
    """The process that computed a batch died, or exceeded the time limit and ended itself."""


class PoolLostError(SafevarError):
    """The pool cannot compute any more batches."""


class Batch(NamedTuple):
    """k filtered settings of n characteristics to evaluate with a task, shape (k, n).

    Attributes
    ----------
    must_succeed
        Whether a failure is an error, not an outcome.
    deaths
        Why workers died since the job's last result: reasons by the setting that they attempted to simulate, b"" for
        several settings.
    """

    packed_task: bytes
    settings: FloatArray
    must_succeed: bool = False
    deaths: Mapping[bytes, tuple[str, ...]] = {}


class Share(NamedTuple):
    """Some of a study's runs, which one worker carries out together.

    Attributes
    ----------
    packed_task
        The task of all settings.
    sumo_task, recorded_task
        Packed tasks that verify results, see `tasks_for_sumo`; both are empty if SUMO simulates everything anyway.
    batch_size
        Maximum number of settings in a batch, which may hold settings of several runs.
    keys
        The runs that are not finished.
    directory
        The directory of the journals, which the worker must see.
    identity
        The digest of the study's identity.
    original
        The original vehicle's evaluation.
    retry_failed
        Whether settings are simulated again that failed before.
    deaths
        See `Batch`.
    """

    packed_task: bytes
    sumo_task: bytes
    recorded_task: bytes
    batch_size: int
    keys: tuple[RunKey, ...]
    directory: Path
    identity: str
    original: Evaluations
    retry_failed: bool
    deaths: Mapping[bytes, tuple[str, ...]] = {}


Job = Batch | Share
Message = bytes | Evaluations | list[RunProgress] | RunResult | RunKey | str
"""What a worker reports of its job, by type: the setting that it attempts to simulate, b"" for several; the result of a
batch; the state of all runs of a share after a round of batches; a finished run; a run that another process carries
out; or a warning.
"""
Report = Callable[[Message], None]


class Pool(Protocol):
    """Workers; a future may fail with `WorkerLostError`, `PoolLostError` or an error of its job."""

    @property
    def workers(self) -> int:
        """Number of jobs that are carried out at the same time."""

    def carry(self, job: Job, report: Report) -> Future[None]:
        """Let a worker carry out a job; `report` is called with every message, and ends the job by an exception."""


def evaluate_batches(
    batches: Sequence[Batch], pool: Pool, done: Callable[[int, int], None] = lambda number, size: None
) -> list[Evaluations]:
    """Evaluate batches; calls `done` with the number of each finished batch, counted from 0, and its size."""
    results = dict[int, Evaluations]()
    with closing(carry_out(batches, pool)) as messages:
        for number, message in messages:
            if isinstance(message, Evaluations):
                results[number] = message
                done(number, len(message))
    return [results[number] for number in range(len(batches))]


def evaluate_original(study: Study, packed_task: bytes, pool: Pool, *, must_succeed: bool = True) -> Evaluations:
    """Evaluate the original vehicle of a study with a task; by default a failure is an error."""
    original = CharacteristicSet.of(study).original[np.newaxis]
    return evaluate_batches([Batch(packed_task, original, must_succeed)], pool)[0]


class _JobUnderWay:
    """A job, its number, the setting that its worker attempts now, and how many workers died outside of an attempt."""

    def __init__(self, number: int, job: Job) -> None:
        self.number, self.job = number, job
        self._attempt: bytes | None = None
        self._losses = 0

    def note(self, message: Message) -> None:
        """Note a worker's message, so that a next worker neither repeats finished runs nor hears of older deaths."""
        if isinstance(message, bytes):
            self._attempt = message
        elif isinstance(message, list):
            self._attempt, self._losses, self.job = None, 0, self.job._replace(deaths={})
        elif isinstance(message, RunResult | RunKey) and isinstance(self.job, Share):
            ended_key = message if isinstance(message, RunKey) else message.progress.key
            self.job = self.job._replace(keys=tuple(key for key in self.job.keys if key != ended_key))

    def note_death(self, error: WorkerLostError) -> None:
        """Note the death of a worker; raises its error if workers die again and again outside of attempts."""
        if self._attempt is None:
            self._losses += 1
            if self._losses > MAX_LOSSES:
                raise error
        else:
            reasons = (*self.job.deaths.get(self._attempt, ()), str(error))
            self.job = self.job._replace(deaths={**self.job.deaths, self._attempt: reasons})
            self._attempt = None


def carry_out(jobs: Sequence[Job], pool: Pool) -> Generator[tuple[int, Message]]:
    """Carry out jobs on a pool, each again if its worker dies; yields every message with its job's number."""
    # An event is a message of a worker or, when the job ends, the future of the job.
    events: SimpleQueue[tuple[_JobUnderWay, Message | Future[None]]] = SimpleQueue()
    waiting, busy_workers, is_over = deque(map(_JobUnderWay, range(len(jobs)), jobs)), 0, False

    def put(started: _JobUnderWay, event: Message | Future[None]) -> None:
        if is_over and not isinstance(event, Future):
            raise PoolLostError("nobody waits for this job any more")
        events.put((started, event))

    try:
        while waiting or busy_workers:
            while waiting and busy_workers < pool.workers:
                started = waiting.popleft()
                busy_workers += 1
                pool.carry(started.job, partial(put, started)).add_done_callback(partial(put, started))
            started, event = wait_for_next(events)
            if not isinstance(event, Future):
                started.note(event)
                yield started.number, event
                continue
            busy_workers -= 1
            error = PoolLostError("the pool was closed") if event.cancelled() else event.exception()
            if error is None and isinstance(started.job, Share) and started.job.keys:
                error = WorkerLostError("a worker ended before its runs")
            if isinstance(error, WorkerLostError):
                started.note_death(error)
                waiting.appendleft(started)
            elif error is not None:
                raise error
    finally:
        is_over = True


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Raise Ctrl-C only in `wait_for_next`, and at the end of this context."""
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
