"""Workers of a Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import logging
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from typing import Any

from safevar_sumo.errors import InputError, SafevarError, describe_error, missing_extra
from safevar_sumo.plugins.process import this_process

CLUSTER = (
    "the address of a Dask scheduler, such as tcp://host:8786; for tls:// certificates in Dask's"
    " configuration: distributed.comm.tls.ca-file and .client.cert, .client.key"
)
CONNECT_TIMEOUT = 10.0
"""Longest time for the scheduler to answer [s]."""
_libsumo_lock = threading.Lock()  # a process has one libsumo


@contextmanager
def connect(address: str) -> Iterator[Any]:
    """Dask's client of the scheduler at an address.

    Raises
    ------
    InputError
        If the extra `cluster` is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise missing_extra("cluster", "Dask is not installed", "cluster") from None
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # this package reports errors itself
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "cluster", f"no scheduler answers at {address!r}: {describe_error(error)}", CLUSTER
        ) from None
    with client:
        yield client


class ClusterWorker:
    """Any worker of a cluster. Dask itself gives the job of a dead worker to others, as often as
    its configuration says (`distributed.scheduler.allowed-failures`).
    """

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(pure=False)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        # Dask's own serialization turns records into lists
        return self._executor.submit(_carry_out, pickle.dumps((function, arguments)))

    def cause_of_death(self, error: BaseException) -> str:
        from distributed import KilledWorker

        if isinstance(error, CancelledError):
            raise SafevarError("the cluster does not answer any more") from None
        return f"workers of the cluster died: {error}" if isinstance(error, KilledWorker) else ""

    def end(self) -> None:
        self._executor.shutdown(wait=False)  # cancels the jobs


def _carry_out(packed_job: bytes) -> Any:
    """Carry out a job in a worker of the cluster."""
    function, arguments = pickle.loads(packed_job)
    with _libsumo_lock:
        this_process.last_words = sys.__stderr__
        return function(*arguments)


def has_caller() -> bool:
    """Whether somebody waits for this job: false in a worker of a cluster if its command has
    ended.
    """
    if "distributed" not in sys.modules:
        return True
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:  # this process is no worker of a cluster
        return True
    return bool(worker.state.tasks[worker.get_current_task()].state != "cancelled")
