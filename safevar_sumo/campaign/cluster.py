"""Workers of a Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import logging
import pickle
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import portalocker

from safevar_sumo.campaign.local import Work
from safevar_sumo.errors import (
    MAX_JOBS,
    InputError,
    SafevarError,
    describe_error,
    missing_extra,
)
from safevar_sumo.plugins.process import this_process

CLUSTER = (
    "the address of a Dask scheduler, such as tcp://host:8786; for tls:// certificates in Dask's"
    " configuration: distributed.comm.tls.ca-file and .client.cert, .client.key"
)
CONNECT_TIMEOUT = 10.0
"""Longest time in which the scheduler must answer [s]."""
_locks = list[portalocker.Lock]()
"""Locks that keep the numbers of this process from other processes."""
_libsumo_lock = threading.Lock()
"""A process has only one libsumo: one thread at a time may simulate."""


@contextmanager
def connect(address: str) -> Iterator[Any]:
    """Connect to the Dask scheduler at an address, and give its client.

    Raises
    ------
    InputError
        If the extra `cluster` is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise missing_extra("cluster", "Dask is not installed", "cluster") from None
    # Dask would print errors that this package reports itself.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "cluster",
            f"no scheduler answers at {address!r}: {describe_error(error)}",
            CLUSTER,
        ) from None
    with client:
        yield client


def everywhere(client: Any, function: Work, *arguments: Any) -> None:
    """Call a function in each worker of a cluster. Errors of the function are raised here."""
    try:
        client.run(_carry_out, pickle.dumps((function, arguments)), "")
    except (AttributeError, ImportError, TypeError) as error:
        # A worker with another version of this package may lack the function.
        raise InputError(
            "cluster",
            f"a worker has another version of safevar_sumo: {describe_error(error)}",
            "the same installation everywhere",
        ) from None


class ClusterWorker:
    """A worker that stands for any worker of a cluster. If a worker of the cluster dies, Dask
    itself gives the job to another worker, as often as Dask's configuration says
    (`distributed.scheduler.allowed-failures`).
    """

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(pure=False)
        self._command = client.id

    def submit(self, function: Work, *arguments: Any) -> Future[Any]:
        # Dask's own serialization would turn records into lists: the job is pickled instead.
        future: Future[Any] = self._executor.submit(
            _carry_out, pickle.dumps((function, arguments)), self._command
        )
        return future

    def cause_of_death(self, error: BaseException) -> str:
        from distributed import KilledWorker

        if isinstance(error, CancelledError):
            raise SafevarError("the cluster does not answer any more") from None
        if isinstance(error, KilledWorker):
            return f"workers of the cluster died: {error}"
        return ""

    def end(self) -> None:
        # The shutdown of the executor cancels its jobs.
        self._executor.shutdown(wait=False)


def _carry_out(packed_job: bytes, command: str) -> Any:
    """Carry out a job in a worker of the cluster. `command` is the id of the client that sent the
    job.
    """
    function, arguments = pickle.loads(packed_job)
    with _libsumo_lock:
        if this_process.last_words is None:
            this_process.worker = _own_number()
        this_process.last_words = sys.__stderr__
        this_process.attempts = (
            Path(gettempdir(), f"safevar-{command}") if command else None
        )
        return function(*arguments)


def _own_number() -> int:
    """The least number that no other worker on this machine has. A lock keeps the number for this
    process.
    """
    for number in range(MAX_JOBS):
        path = Path(gettempdir(), f"safevar-worker-{number}.lock")
        lock = portalocker.Lock(path, "a", timeout=0, fail_when_locked=True)
        with suppress(OSError, portalocker.LockException):
            lock.acquire()
            _locks.append(lock)
            return number
    return MAX_JOBS


def has_caller() -> bool:
    """Return whether somebody waits for this job. False in a worker of a cluster whose command has
    ended.
    """
    if "distributed" not in sys.modules:
        return True
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        # `get_worker` raises this error in a process that is no worker of a cluster.
        return True
    return bool(worker.state.tasks[worker.get_current_task()].state != "cancelled")
