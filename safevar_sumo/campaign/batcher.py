"""Batches gathered from what several runs ask for: large ones cost least, and nobody is to wait for work."""

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
"""Settings that an idle worker gets at the least, of what few runs ask for: fewer take as long to simulate."""
BATCHES_PER_WORKER = 2
"""How many batches are under way for each worker: one is computed while another is searched and journalled."""
MOST_RUNS = 256
"""Runs under way at the most: each keeps a file open."""


class Batcher:
    """Settings that runs ask for, in the order in which they asked, and batches of them under way.

    Parameters
    ----------
    work
        The packed study.
    size
        Settings per batch at the most.
    """

    def __init__(self, pool: RetryingPool, work: bytes, size: int) -> None:
        self._pool, self._work, self._size = pool, work, size
        self._asked: deque[tuple[Run, FloatArray]] = deque()
        self.under_way: dict[Future[Evaluations], list[Run]] = {}

    def runs_wanted(self, population: int) -> int:
        """How many runs with populations of a size keep all workers busy."""
        return min(math.ceil(BATCHES_PER_WORKER * self._pool.workers * self._size / population), MOST_RUNS)

    def ask(self, run: Run, settings: FloatArray) -> None:
        """Have settings of a run, shape (k, n), computed sooner or later."""
        self._asked.extend((run, setting) for setting in settings)

    def send(self) -> None:
        """Send what pays now: full batches ahead of the workers; all that there is, evenly, if workers are idle."""
        while self._asked and (number := self._number()):
            taken = [self._asked.popleft() for _ in range(min(number, len(self._asked)))]
            settings = np.array([setting for _, setting in taken])
            self.under_way[self._pool.submit(self._work, settings)] = [run for run, _ in taken]

    def _number(self) -> int:
        """How many settings the next batch has; none, if it is better to wait for more of them."""
        workers, asked = self._pool.workers, len(self._asked)
        idle = workers - len(self.under_way)
        if idle > 0:
            return min(max(math.ceil(asked / idle), LEAST_SHARE), self._size)
        ahead = len(self.under_way) < BATCHES_PER_WORKER * workers and 2 * asked >= self._size
        return self._size if ahead else 0

    def take(self, batch: Future[Evaluations]) -> Iterator[tuple[Run, Evaluations]]:
        """Every run's share of a computed batch."""
        runs, evaluations = self.under_way.pop(batch), batch.result()
        for run in dict.fromkeys(runs):
            yield run, evaluations.take([row for row, owner in enumerate(runs) if owner is run])
