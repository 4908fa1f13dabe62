"""Gathers settings of several runs into batches: as large as possible, because these cost least, but without idle workers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future

import numpy as np

from safevar_sumo.campaign.run import Run
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.workers.retrying import RetryingPool

MIN_BATCH_FOR_IDLE_WORKER = 10
"""Minimum number of settings in a batch for an idle worker, if the queue holds enough: a smaller batch takes as long."""
BATCHES_PER_WORKER = 2
"""Number of batches under way per worker: the worker simulates one of them while the main process journals another."""
MAX_RUNS = 256
"""Maximum number of runs under way: each run keeps a file open."""


class Batcher:
    """A queue of settings in the order of request, and the batches under way.

    Parameters
    ----------
    work
        The packed study.
    max_size
        Maximum number of settings per batch.
    """

    def __init__(self, pool: RetryingPool, work: bytes, max_size: int) -> None:
        self._pool, self._work, self._max_size = pool, work, max_size
        self._queue: deque[tuple[Run, FloatArray]] = deque()
        self.under_way: dict[Future[Evaluations], list[Run]] = {}
        """By batch: the run of each of its settings."""

    def wanted_run_count(self, population: int) -> int:
        """The number of runs, each with `population` settings at a time, that keep all workers busy."""
        return min(math.ceil(BATCHES_PER_WORKER * self._pool.workers * self._max_size / population), MAX_RUNS)

    def add(self, run: Run, settings: FloatArray) -> None:
        """Queue k settings of n characteristics, shape (k, n), for a run."""
        self._queue.extend((run, setting) for setting in settings)

    def send(self) -> None:
        """Send all queued settings in equal batches to the idle workers; if no worker is idle, send full batches ahead."""
        while self._queue and (size := self._size_of_next_batch()):
            batch = [self._queue.popleft() for _ in range(min(size, len(self._queue)))]
            settings = np.array([setting for _, setting in batch])
            self.under_way[self._pool.submit(self._work, settings)] = [run for run, _ in batch]

    def _size_of_next_batch(self) -> int:
        """Number of settings of the next batch; 0 if more settings should be queued first."""
        workers, queue_length = self._pool.workers, len(self._queue)
        idle_workers = workers - len(self.under_way)
        if idle_workers > 0:
            return min(max(math.ceil(queue_length / idle_workers), MIN_BATCH_FOR_IDLE_WORKER), self._max_size)
        fits_ahead = len(self.under_way) < BATCHES_PER_WORKER * workers and 2 * queue_length >= self._max_size
        return self._max_size if fits_ahead else 0

    def collect(self, batch: Future[Evaluations]) -> Iterator[tuple[Run, Evaluations]]:
        """Yield each run of a computed batch, with the evaluations of its settings."""
        runs, evaluations = self.under_way.pop(batch), batch.result()
        for run in dict.fromkeys(runs):
            yield run, evaluations.take([row for row, run_of_row in enumerate(runs) if run_of_row is run])
