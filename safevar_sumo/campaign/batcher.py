"""Gathers settings of several runs into batches: large batches cost least, and no worker is to wait for work."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future

import numpy as np

from safevar_sumo.campaign.run import Run
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.workers.retrying import RetryingPool

LEAST_SHARE = 10
"""Minimum number of settings for an idle worker, if so many are queued: fewer take as long to simulate."""
BATCHES_PER_WORKER = 2
"""Number of batches under way per worker: one is simulated while another is journalled and answers its searches."""
MOST_RUNS = 256
"""Maximum number of runs under way: each keeps a file open."""


class Batcher:
    """Queued settings of runs, in order of request, and batches of them under way.

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
        """Number of runs with populations of a size that keep all workers busy."""
        return min(math.ceil(BATCHES_PER_WORKER * self._pool.workers * self._size / population), MOST_RUNS)

    def add(self, run: Run, settings: FloatArray) -> None:
        """Queue settings of a run, shape (k, n)."""
        self._queue.extend((run, setting) for setting in settings)

    def send(self) -> None:
        """Send the batches that pay now: all queued settings, evenly, to idle workers; full batches ahead of busy ones."""
        while self._queue and (number := self._next_size()):
            batch = [self._queue.popleft() for _ in range(min(number, len(self._queue)))]
            settings = np.array([setting for _, setting in batch])
            self.under_way[self._pool.submit(self._work, settings)] = [run for run, _ in batch]

    def _next_size(self) -> int:
        """Number of settings of the next batch; 0 if it is better to wait for more."""
        workers, queued = self._pool.workers, len(self._queue)
        idle = workers - len(self.under_way)
        if idle > 0:
            return min(max(math.ceil(queued / idle), LEAST_SHARE), self._size)
        ahead = len(self.under_way) < BATCHES_PER_WORKER * workers and 2 * queued >= self._size
        return self._size if ahead else 0

    def take(self, batch: Future[Evaluations]) -> Iterator[tuple[Run, Evaluations]]:
        """Every run's share of a computed batch."""
        runs, evaluations = self.under_way.pop(batch), batch.result()
        for run in dict.fromkeys(runs):
            yield run, evaluations.take([row for row, owner in enumerate(runs) if owner is run])
