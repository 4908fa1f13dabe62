"""Batches computed by the workers of a Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError, describe_error
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import RESULTS
from safevar_sumo.workers.evaluation import PoolLostError, WorkerLostError, evaluate_batch
from safevar_sumo.workers.interrupts import defer_interrupts

ADDRESS = re.compile(r"[a-z]+://[^\s/]+:\d+/?")
CERTIFICATES = "for tls:// certificates in Dask's configuration: distributed.comm.tls.ca-file and .client.cert, .client.key"
CONNECT_TIMEOUT = 10.0
"""Longest time for the scheduler to answer [s]."""
SECONDS_BETWEEN_COUNTS = 5.0
VERSIONED_PACKAGES = ("safevar_sumo", "libsumo", "numpy")
"""Packages that must have the same version in this process and on every worker."""
_libsumo_lock = threading.Lock()


@contextmanager
def cluster_pool(address: str, time_limit: float) -> Iterator[ClusterPool]:
    """Connect to a scheduler.

    Parameters
    ----------
    address
        Address of the scheduler.
    time_limit
        Time limit of a batch [s]; a worker that exceeds it is stopped.

    Raises
    ------
    InputError
        If the extra `cluster` is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("cluster", "Dask is not installed", "in the checkout: pip install '.[cluster]'") from None
    legal = "the address of a Dask scheduler, such as tcp://host:8786"
    if not ADDRESS.fullmatch(address):
        raise InputError("cluster", repr(address), legal)
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # this package reports errors itself
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError("cluster", f"no scheduler answers at {address!r}: {error}", legal) from None
    except (TypeError, RuntimeError) as error:
        raise InputError("cluster", f"{address!r}: {describe_error(error)}", CERTIFICATES) from None
    with defer_interrupts():
        try:
            yield ClusterPool(client, time_limit)
        finally:
            client.close()


class ClusterPool:
    """Computes batches on a Dask cluster; Dask repeats the batch of a dead worker."""

    def __init__(self, client: Any, time_limit: float) -> None:
        self._executor = client.get_executor(pure=False)
        self._client, self._time_limit = client, time_limit
        self._workers, self._time_of_count = 1, -np.inf

    @property
    def workers(self) -> int:
        """Number of worker processes, counted every few seconds; each process computes one batch at a time."""
        now = time.monotonic()
        if now - self._time_of_count > SECONDS_BETWEEN_COUNTS:
            try:
                self._workers = max(1, len(self._client.nthreads()))
            except (OSError, TimeoutError) as error:
                raise PoolLostError(f"the cluster does not answer any more: {error}") from None
            self._time_of_count = now
        return self._workers

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        try:
            dask_future = self._executor.submit(_evaluate_in_time, self._time_limit, _versions(), work, settings)
        except RuntimeError as error:
            raise PoolLostError(f"the cluster does not answer any more: {error}") from None
        dask_future.add_done_callback(lambda source: _forward_result(source, future))
        return future


def _evaluate_in_time(time_limit: float, versions: dict[str, str], work: bytes, settings: FloatArray) -> Evaluations:
    """Evaluate a batch in a worker, one at a time because a process has one libsumo; end a worker that hangs."""
    if _versions() != versions:
        raise PoolLostError(f"a worker of the cluster has other versions: {_versions()} there, {versions} here")
    with _libsumo_lock, open(os.devnull, "w") as null_file:
        faulthandler.dump_traceback_later(time_limit, exit=True, file=null_file)
        try:
            return evaluate_batch(work, settings)
        finally:
            faulthandler.cancel_dump_traceback_later()


@cache
def _versions() -> dict[str, str]:
    return {**{name: version(name) for name in VERSIONED_PACKAGES}, "results": str(RESULTS)}


def _forward_result(dask_future: Future[Evaluations], future: Future[Evaluations]) -> None:
    from distributed import KilledWorker

    if dask_future.cancelled():
        future.set_exception(PoolLostError("the cluster does not answer any more"))
        return
    error = dask_future.exception()
    if isinstance(error, KilledWorker):
        future.set_exception(WorkerLostError(f"workers of the cluster died: {error}"))
    elif error is not None:
        future.set_exception(error)
    else:
        future.set_result(dask_future.result())
