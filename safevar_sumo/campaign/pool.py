"""Jobs for the workers of a pool: batches of settings for questions, and shares of a study's runs; what workers report;
and the loop that carries jobs out although workers die.

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

from safevar_sumo.errors import SafevarError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import Failure, run_name

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


class RunKey(NamedTuple):
    """One run of an algorithm; the number `run` counts from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return run_name(self.algorithm, self.run)


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


class Batch(NamedTuple):
    """Filtered settings of a packed study to evaluate, shape (k, n).

    With `must_succeed` a failure is an error, not an outcome. `deaths` says, for each attempt since the job's last
    result, why workers died: by setting, or b"" for several settings.
    """

    work: bytes
    settings: FloatArray
    must_succeed: bool = False
    deaths: Mapping[bytes, tuple[str, ...]] = {}


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
        See `Batch`.
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


Job = Batch | Share
Message = bytes | Evaluations | list[RunProgress] | RunResult | RunKey | str
"""What a worker reports of its job: the setting that it attempts to simulate, b"" for several; the result of a batch;
the state of all runs of a share after a round of batches; a finished run; a run that another process carries out; or a
warning.
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
    batches: Sequence[Batch], pool: Pool, done: Callable[[int, int], None] = lambda batch, size: None
) -> list[Evaluations]:
    """Evaluate batches; calls `done` with the number of each batch that is finished, and its size."""
    results = dict[int, Evaluations]()
    with closing(carry_out(batches, pool)) as messages:
        for number, message in messages:
            if isinstance(message, Evaluations):
                results[number] = message
                done(number, len(message))
    return [results[number] for number in range(len(batches))]


class _JobUnderWay:
    """A job, its number, the attempt that its worker makes now, and the workers that died outside of an attempt."""

    def __init__(self, number: int, job: Job) -> None:
        self.number, self.job = number, job
        self._attempt: bytes | None = None
        self._losses = 0

    def note(self, message: Message) -> None:
        """Note a worker's message: the next worker does not repeat what is finished, and knows of deaths since then."""
        if isinstance(message, bytes):
            self._attempt = message
        elif isinstance(message, list):
            self._attempt, self._losses, self.job = None, 0, self.job._replace(deaths={})
        elif isinstance(message, RunResult | RunKey) and isinstance(self.job, Share):
            finished = message if isinstance(message, RunKey) else message.progress.key
            self.job = self.job._replace(keys=tuple(key for key in self.job.keys if key != finished))

    def note_death(self, error: WorkerLostError) -> None:
        """Note the death of a worker; raises its error if it is no attempt's fault and occurs again and again."""
        if self._attempt is None:
            self._losses += 1
            if self._losses > MAX_LOSSES:
                raise error
        else:
            deaths = self.job.deaths
            reasons = (*deaths.get(self._attempt, ()), str(error))
            self.job, self._attempt = self.job._replace(deaths={**deaths, self._attempt: reasons}), None


def carry_out(jobs: Sequence[Job], pool: Pool) -> Generator[tuple[int, Message]]:
    """Carry out jobs on a pool, each again after the death of its worker; yields the number of a job and a message."""
    events: SimpleQueue[tuple[_JobUnderWay, Message | Future[None]]] = SimpleQueue()
    waiting, under_way, is_over = deque(map(_JobUnderWay, range(len(jobs)), jobs)), 0, False

    def put(job: _JobUnderWay, event: Message | Future[None]) -> None:
        if is_over and not isinstance(event, Future):
            raise PoolLostError("nobody waits for this job any more")
        events.put((job, event))

    try:
        while waiting or under_way:
            while waiting and under_way < pool.workers:
                job = waiting.popleft()
                under_way += 1
                pool.carry(job.job, partial(put, job)).add_done_callback(partial(put, job))
            job, event = wait_for_next(events)
            if not isinstance(event, Future):
                job.note(event)
                yield job.number, event
                continue
            under_way -= 1
            error = PoolLostError("the pool was closed") if event.cancelled() else event.exception()
            if error is None and isinstance(job.job, Share) and job.job.keys:
                error = WorkerLostError("a worker ended before its runs")
            if isinstance(error, WorkerLostError):
                job.note_death(error)
                waiting.appendleft(job)
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
