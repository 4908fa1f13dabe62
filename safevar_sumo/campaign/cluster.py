"""Workers of a Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import logging
import os
import pickle
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.metadata import version
from typing import Any
from uuid import uuid4

from safevar_sumo.campaign.evaluation import evaluate_in_time
from safevar_sumo.campaign.pool import Job, Message, PoolLostError, Report, WorkerLostError, defer_interrupts
from safevar_sumo.campaign.worker import carry_out_job
from safevar_sumo.errors import InputError, SafevarError, describe_error
from safevar_sumo.results import RESULTS

CLUSTER = (
    "the address of a Dask scheduler, such as tcp://host:8786; for tls:// certificates in Dask's configuration: "
    "distributed.comm.tls.ca-file and .client.cert, .client.key"
)
CONNECT_TIMEOUT = 10.0
"""Longest time for the scheduler to answer [s]."""
SECONDS_BETWEEN_LOOKS = 0.5
"""Time between two looks at whether a job has ended without a message [s]."""
MAX_JOBS = 1024
"""Maximum number of jobs at the same time."""
GONE = "the cluster does not answer any more"
VERSIONED_PACKAGES = ("safevar_sumo", "libsumo", "numpy")
"""Packages that must have the same version in this process and on every worker."""
_libsumo_lock = threading.Lock()  # a process has one libsumo


@contextmanager
def cluster_pool(address: str, time_limit: float) -> Iterator[ClusterPool]:
    """Connect to a scheduler.

    Parameters
    ----------
    address
        Address of the scheduler.
    time_limit
        Time limit of a batch [s]; a worker that exceeds it ends.

    Raises
    ------
    InputError
        If the extra `cluster` is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("cluster", "Dask is not installed", "in the checkout: pip install '.[cluster]'") from None
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # this package reports errors itself
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
        raise InputError("cluster", f"no scheduler answers at {address!r}: {describe_error(error)}", CLUSTER) from None
    with defer_interrupts():
        try:
            yield ClusterPool(client, time_limit)
        finally:
            client.close()


class ClusterPool:
    """Carries out jobs on a Dask cluster, which repeats the job of a dead worker. For each job, a thread waits for
    messages.
    """

    def __init__(self, client: Any, time_limit: float) -> None:
        self._threads = ThreadPoolExecutor(MAX_JOBS, thread_name_prefix="job")
        self._client, self._time_limit = client, time_limit

    @property
    def workers(self) -> int:
        """Number of worker processes; each carries out one job at a time."""
        try:
            return max(1, len(self._client.nthreads()))
        except (OSError, TimeoutError) as error:
            raise PoolLostError(f"{GONE}: {error}") from None

    def carry(self, job: Job, report: Report) -> Future[None]:
        return self._threads.submit(self._carry, job, report)

    def _carry(self, job: Job, report: Report) -> None:
        from distributed import KilledWorker, Queue

        def receive() -> Message | None:
            is_over = False
            while not is_over:
                is_over = future.done()  # its last messages may still wait
                with suppress(TimeoutError):
                    return pickle.loads(messages.get(timeout=SECONDS_BETWEEN_LOOKS))  # type: ignore[no-any-return]
            return None

        try:
            name = f"safevar-{uuid4()}"
            messages = Queue(name, client=self._client)
            future = self._client.submit(_carry_in_worker, self._time_limit, _versions(), job, name, pure=False)
            while (message := receive()) is not None:
                report(message)
        except SafevarError:
            future.cancel()
            raise
        except Exception as error:
            raise PoolLostError(f"{GONE}: {describe_error(error)}") from None
        try:
            future.result()
        except KilledWorker as error:
            raise WorkerLostError(f"workers of the cluster died: {error}") from None
        except CancelledError:
            raise PoolLostError(GONE) from None


def _carry_in_worker(time_limit: float, versions: dict[str, str], job: Job, queue: str) -> None:
    """Carry out a job in a worker; a message, put into a Dask queue, ends the job if the caller is gone."""
    from distributed import Queue, get_worker

    worker, messages = get_worker(), Queue(queue)
    dask_task = worker.state.tasks[worker.get_current_task()]

    def report(message: Message | None) -> None:
        if dask_task.state == "cancelled":
            raise PoolLostError("the caller is gone")
        messages.put(pickle.dumps(message))  # Dask's own serialization turns records into lists

    if _versions() != versions:
        raise PoolLostError(f"a worker of the cluster has other versions: {_versions()} there, {versions} here")
    with _libsumo_lock, open(os.devnull, "w") as null_file:
        carry_out_job(job, report, partial(evaluate_in_time, time_limit=time_limit, last_words=null_file))
    report(None)


@cache
def _versions() -> dict[str, str]:
    return {**{name: version(name) for name in VERSIONED_PACKAGES}, "results": str(RESULTS)}
