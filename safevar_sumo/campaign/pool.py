"""A pool of workers: processes of this machine, or workers of a Dask cluster. A worker carries out
one job at a time.

A job is a plain function with its arguments. Both are sent to the worker. `carry_out` in
`campaign/evaluation.py` gives jobs to a pool.
"""

from __future__ import annotations

import logging
import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack, contextmanager, suppress
from numbers import Integral
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, Protocol

from safevar_sumo.campaign import cluster as dask, local
from safevar_sumo.campaign.local import Work
from safevar_sumo.errors import MAX_JOBS, InputError, SafevarError
from safevar_sumo.output import temporary_folder
from safevar_sumo.plugins.process import MAX_DEATHS
from safevar_sumo.records import Evaluations, JsonObject

Look = Callable[[Sequence[int]], None]
"""A function that gets the numbers of the jobs that have just ended."""
Home = tuple[str, ...]
"""The folders of a study with user code. Whatever user code does to its process, it does to no
process of another home. () for studies without user code, which any worker carries out.
"""
LOGGER = logging.getLogger(__name__)
SECONDS_BETWEEN_LOOKS = 0.5
"""Longest time between two calls of a `Look` [s]."""


class Spare(NamedTuple):
    """Numbers of simulations that checks may take, if simulations are limited: the check of a
    simulator's class, and the repetition of first batches.
    """

    check: int
    repetition: int


class WorkerLostError(SafevarError):
    """The error after the deaths of more than `MAX_DEATHS` workers in a job. `job` is the number of
    the job.
    """

    def __init__(self, job: int, cause: str) -> None:
        super().__init__(cause)
        self.job = job


class Worker(Protocol):
    """An executor with one worker."""

    def submit(self, function: Work, *arguments: Any) -> Future[Any]:
        """Begin a job, and return its future result."""

    def cause_of_death(self, error: BaseException) -> str:
        """The reason why the worker died, if the error of its job shows that it died; ""
        otherwise.
        """

    def end(self) -> None:
        """End the worker. In a cluster, only its jobs end."""


class Pool:
    """Workers, which start when they are needed for the first time.

    Attributes
    ----------
    workers
        Number of jobs that are carried out at the same time.
    opened
        The names of the files that user code opens. Keys are the names of the user code, and the
        study's name with the folders in which code is looked up.
    inputs
        For each study (packed): the manifest of its inputs when the pool first met the study.
    verified
        For each study (packed): the number of settings whose results were verified.
    compiled
        Names of the vehicle models that are already compiled.
    simulated, failed
        Numbers of simulated and of failed settings in questions about studies that skip failures.
    checked
        Number of simulations of the last check of user code.
    spare
        Largest numbers of simulations of a check and of repeats, in a simulator of the user's own;
        None without a limit.
    shared
        The evaluations that the questions of a page share, for each study with a selection, and for
        each setting; None if questions share nothing.
    on_cluster
        A function that carries out a job in each worker of a cluster; None for processes of this
        machine.
    attempts
        The folder in which workers note the settings that they simulate, if failures are skipped.
    """

    def __init__(self, workers: int, start: Callable[[int], Worker]) -> None:
        self.workers = workers
        self._start = start
        self._started = dict[int, Worker]()
        self._homes = dict[int, Home]()
        self.opened = dict[tuple[frozenset[str], tuple[str, ...]], list[str]]()
        self.inputs = dict[bytes, JsonObject]()
        self.verified = Counter[bytes]()
        self.compiled = set[str]()
        self.attempts: Path | None = None
        self.simulated = 0
        self.failed = 0
        self.checked = 0
        self.spare: Spare | None = None
        self.shared: dict[bytes, dict[bytes, Evaluations]] | None = None
        self.on_cluster: Work | None = None

    def map(
        self,
        function: Work,
        jobs: Sequence[tuple[Any, ...]],
        look: Look = lambda ended: None,
        home: Home = (),
    ) -> list[Any]:
        """Call a function with the arguments of each job, and return the results in the order of
        the jobs. A job whose worker dies is carried out once more. Only workers that run no user
        code of another `home` carry out the jobs.

        `look` is called with the numbers of the jobs that have just ended, and at least twice a
        second.

        Raises
        ------
        WorkerLostError
            If another worker dies in the same job.
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
                worker = self._worker_at(place, home)
                future = self._begin(worker, function, jobs[number])
                under_way[future] = place, worker, number
                future.add_done_callback(ended.put)

            try:
                future = ended.get(timeout=SECONDS_BETWEEN_LOOKS)
            except Empty:
                look([])
                continue
            place, worker, number = under_way.pop(future)
            idle.appendleft(place)

            # The worker may have died by chance. Therefore its job is carried out again, up to a
            # few times.
            error = future.exception()
            if error is None:
                results[number] = future.result()
                look([number])
            elif cause := self._started[worker].cause_of_death(error):
                self._started.pop(worker).end()
                deaths[number] += 1
                LOGGER.warning(
                    "worker %d was lost in job %d: %s", worker, number, cause
                )
                if deaths[number] > MAX_DEATHS + (MAX_DEATHS + 1) * self._skipped():
                    raise WorkerLostError(number, cause)
                waiting.appendleft(number)
            else:
                raise error
        return [results[number] for number in range(len(jobs))]

    def _skipped(self) -> int:
        """The number of settings that are skipped, because too many workers have died of them."""
        folders = self.attempts.glob("*") if self.attempts else ()
        return sum(len(list(folder.iterdir())) > MAX_DEATHS for folder in folders)

    def everywhere(
        self, function: Work, *arguments: Any, home: Home, limit: int | None = None
    ) -> None:
        """Call a function in each living worker that runs user code of a `home`, or in `limit` of
        them.
        """
        workers = [
            number for number in self._started if self._homes.get(number) == home
        ]
        futures = [
            self._begin(number, function, arguments) for number in workers[:limit]
        ]
        for future in futures:
            future.result()

    def close(self) -> None:
        """End all workers."""
        while self._started:
            self._started.popitem()[1].end()

    def _worker_at(self, place: int, home: Home) -> int:
        """The number of the worker that carries out jobs at a place of the pool. User code of each
        home has a worker of its own there: the first one has the number of the place.
        """
        worker = place
        while home and self._homes.setdefault(worker, home) != home:
            worker += self.workers
        return worker

    def _begin(self, worker: int, function: Work, job: tuple[Any, ...]) -> Future[Any]:
        """Begin a job in the worker with this number or, if this worker is dead, in a new one."""
        if worker in self._started:
            # The process of the worker may have died between two jobs.
            with suppress(BrokenExecutor):
                return self._started[worker].submit(function, *job)
            self._started.pop(worker).end()
        LOGGER.debug("worker %d starts", worker)
        self._started[worker] = self._start(worker)
        return self._started[worker].submit(function, *job)


def available_cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def open_pool(jobs: int | None = None, cluster: str | None = None) -> Iterator[Pool]:
    """Open a pool of `jobs` processes, by default one for each core, or of the workers of the Dask
    scheduler at the address `cluster`. The workers end with the context.

    Raises
    ------
    InputError
        If `jobs` is no number of processes, the scheduler does not answer, or the extra `cluster`
        is not installed.
    """
    if jobs is not None and (
        isinstance(jobs, bool)
        or not isinstance(jobs, Integral)
        or not 1 <= jobs <= MAX_JOBS
    ):
        raise InputError("jobs", repr(jobs), f"a whole number from 1 to {MAX_JOBS:,}")
    with ExitStack() as stack:
        if cluster is None:
            folder = stack.enter_context(temporary_folder())
            pool = Pool(
                jobs or available_cores(),
                lambda number: local.ProcessWorker(folder / f"{number}.txt"),
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
