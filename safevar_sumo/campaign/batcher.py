"""Gathers settings of several runs into batches, large ones because they cost least, without idle workers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future

import numpy as np

from safevar_sumo.campaign.run import Run
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.workers.retrying import RetryingPool

MIN_SHARE = 10
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
    size
        Maximum number of settings per batch.
    """

    def __init__(self, pool: RetryingPool, work: bytes, size: int) -> None:
        self._pool, self._work, self._size = pool, work, size
        self._queue: deque[tuple[Run, FloatArray]] = deque()
        self.under_way: dict[Future[Evaluations], list[Run]] = {}

    def runs_wanted(self, population: int) -> int:
        """Number of runs, each with `population` settings at a time, that keep all workers busy."""
        return min(math.ceil(BATCHES_PER_WORKER * self._pool.workers * self._size / population), MAX_RUNS)

    def add(self, run: Run, settings: FloatArray) -> None:
        """Queue k settings of n characteristics, shape (k, n), for a run."""
        self._queue.extend((run, setting) for setting in settings)

    def send(self) -> None:
        """Send all queued settings, in equal batches, to idle workers; without idle workers, send full batches ahead."""
        while self._queue and (number := self._next_size()):
            batch = [self._queue.popleft() for _ in range(min(number, len(self._queue)))]
            settings = np.array([setting for _, setting in batch])
            self.under_way[self._pool.submit(self._work, settings)] = [run for run, _ in batch]

    def _next_size(self) -> int:
        """Number of settings of the next batch; 0 if more settings should be queued first."""
        workers, queue_length = self._pool.workers, len(self._queue)
        idle_workers = workers - len(self.under_way)
        if idle_workers > 0:
            return min(max(math.ceil(queue_length / idle_workers), MIN_SHARE), self._size)
        fits_ahead = len(self.under_way) < BATCHES_PER_WORKER * workers and 2 * queue_length >= self._size
        return self._size if fits_ahead else 0

    def take(self, batch: Future[Evaluations]) -> Iterator[tuple[Run, Evaluations]]:
        """Each run of a computed batch, with the evaluations of its settings."""
        runs, evaluations = self.under_way.pop(batch), batch.result()
        for run in dict.fromkeys(runs):
            yield run, evaluations.take([row for row, owner in enumerate(runs) if owner is run])
