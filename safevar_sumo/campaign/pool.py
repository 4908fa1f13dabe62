"""A pool of workers: processes of this machine, or the workers of a Dask cluster. Each carries out
one job at a time.

A job is a plain function with its arguments, which are sent to the worker. `carry_out` in
`campaign/evaluation.py` gives jobs to a pool.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack, contextmanager, suppress
from numbers import Integral
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Protocol

from safevar_sumo.campaign import cluster as dask, local
from safevar_sumo.campaign.local import Work
from safevar_sumo.errors import MAX_JOBS, InputError, SafevarError
from safevar_sumo.output import temporary_folder
from safevar_sumo.plugins.process import MAX_DEATHS
from safevar_sumo.records import Evaluations, JsonObject

Look = Callable[[Sequence[int]], None]
"""A function that is told the numbers of jobs that have just ended."""
SECONDS_BETWEEN_LOOKS = 0.5
"""Longest time between two looks at the jobs under way [s]."""


class WorkerLostError(SafevarError):
    """More than `MAX_DEATHS` workers died of a job; `job` is its number."""

    def __init__(self, job: int, cause: str) -> None:
        super().__init__(cause)
        self.job = job


class Worker(Protocol):
    """An executor with one worker."""

    def submit(self, function: Work, *arguments: Any) -> Future[Any]:
        """Begin a job."""

    def cause_of_death(self, error: BaseException) -> str:
        """Why the worker died, if this is what an error of its job says; "" if it did not die."""

    def end(self) -> None:
        """End the worker, or, in a cluster, its jobs."""


class Pool:
    """Workers, which start when they are first needed.

    Attributes
    ----------
    workers
        Number of jobs that are carried out at the same time.
    opened
        The names of the files that the user code of studies opens, by the names of the code, and
        the study's name with the folders in which code is looked up.
    inputs
        The inputs of a study's results when it was new to the pool, a manifest, by packed study.
    verified
        Number of settings whose results were verified, by packed study.
    compiled
        Names of the vehicle models that workers find compiled.
    simulated, failed
        Number of settings that questions have had, of studies that skip those that fail.
    checked, spare
        Number of simulations of the last check of user code; the largest numbers of a check and of
        repeats in a simulator of the user's own, None if they are not limited.
    shared
        What the questions of a page have simulated: evaluations by setting, of each study and
        selection; None if questions do not share it.
    on_cluster
        Carries out a function in each worker of a cluster; None for processes of this machine.
    attempts
        The folder in which workers note the settings that may be skipped while they simulate them.
    """

    def __init__(self, workers: int, start: Callable[[int], Worker]) -> None:
        self.workers = workers
        self._start = start
        self._started = dict[int, Worker]()
        self.opened = dict[tuple[frozenset[str], tuple[str, ...]], list[str]]()
        self.inputs = dict[bytes, JsonObject]()
        self.verified = Counter[bytes]()
        self.compiled = set[str]()
        self.attempts: Path | None = None
        self.simulated = self.failed = self.checked = 0
        self.spare: tuple[int, int] | None = None
        self.shared: dict[bytes, dict[bytes, Evaluations]] | None = None
        self.on_cluster: Work | None = None

    def map(
        self,
        function: Work,
        jobs: Sequence[tuple[Any, ...]],
        look: Look = lambda ended: None,
    ) -> list[Any]:
        """The results of a function for the arguments of each job, in their order; a job whose
        worker dies is carried out once more.

        `look` is called with the numbers of the jobs that have just ended, and at least twice a
        second.

        Raises
        ------
        WorkerLostError
            If another worker dies of the same job.
        """
        results = dict[int, Any]()
        deaths = Counter[int]()
        waiting = deque(range(len(jobs)))
        idle = deque(range(self.workers))
        ended = SimpleQueue[Future[Any]]()
        under_way = {}
        while len(results) < len(jobs):
            while waiting and idle:
                place = idle.popleft()
                number = waiting.popleft()
                future = self._begin(place, function, jobs[number])
                under_way[future] = place, number
                future.add_done_callback(ended.put)

            try:
                future = ended.get(timeout=SECONDS_BETWEEN_LOOKS)
            except Empty:
                look([])
                continue
            place, number = under_way.pop(future)
            idle.appendleft(place)

            # The worker may have died by chance: its job waits again, a few times.
            error = future.exception()
            if error is None:
                results[number] = future.result()
                look([number])
            elif cause := self._started[place].cause_of_death(error):
                self._started.pop(place).end()
                deaths[number] += 1
                if deaths[number] > MAX_DEATHS + (MAX_DEATHS + 1) * self._skipped():
                    raise WorkerLostError(number, cause)
                waiting.appendleft(number)
            else:
                raise error
        return [results[number] for number in range(len(jobs))]

    def _skipped(self) -> int:
        """Number of settings of which so many workers have died that they are skipped."""
        folders = (
            self.attempts.iterdir() if self.attempts and self.attempts.exists() else ()
        )
        return sum(len(list(folder.iterdir())) > MAX_DEATHS for folder in folders)

    def everywhere(
        self, function: Work, *arguments: Any, limit: int | None = None
    ) -> None:
        """Carry out a function in each worker that has started and lives, or in so many of them."""
        places = list(self._started)[:limit]
        futures = [self._begin(place, function, arguments) for place in places]
        for future in futures:
            future.result()

    def close(self) -> None:
        """End all workers."""
        while self._started:
            self._started.popitem()[1].end()

    def _begin(self, place: int, function: Work, job: tuple[Any, ...]) -> Future[Any]:
        if place in self._started:
            # Its process may have died between two jobs.
            with suppress(BrokenExecutor):
                return self._started[place].submit(function, *job)
            self._started.pop(place).end()
        self._started[place] = self._start(place)
        return self._started[place].submit(function, *job)


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def open_pool(jobs: int | None = None, cluster: str | None = None) -> Iterator[Pool]:
    """A pool of `jobs` processes, by default one for each core, or of the workers of the Dask
    scheduler at an address; they end with the context.

    Raises
    ------
    InputError
        If `jobs` is no number of processes, the scheduler does not answer, or the extra `cluster`
        is not installed.
    """
    if jobs is not None and (
        isinstance(jobs, bool)
        or not isinstance(jobs, Integral)
        or not 1 <= int(jobs) <= MAX_JOBS
    ):
        raise InputError("jobs", repr(jobs), f"a whole number from 1 to {MAX_JOBS:,}")
    with ExitStack() as stack:
        if cluster is None:
            folder = stack.enter_context(temporary_folder())
            pool = Pool(
                jobs or available_cores(),
                lambda place: local.ProcessWorker(folder / f"{place}.txt"),
            )
            pool.attempts = folder / local.ATTEMPTS
        else:
            client = stack.enter_context(dask.connect(cluster))
            pool = Pool(
                max(1, len(client.nthreads())), lambda place: dask.ClusterWorker(client)
            )
            pool.on_cluster = lambda *job: dask.everywhere(client, *job)
        stack.callback(pool.close)
        yield pool
