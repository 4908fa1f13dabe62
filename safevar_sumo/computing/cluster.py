"""Batches computed by the workers of a Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from safevar_sumo.computing.base import WorkerLostError, evaluate_batch
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray

ADDRESS = re.compile(r"[a-z]+://[^\s/]+:\d+/?")
CONNECT_TIMEOUT = 10.0
"""How long an address may take to answer [s]."""


@contextmanager
def cluster_pool(address: str) -> Iterator[ClusterPool]:
    """Connect to a scheduler.

    Raises
    ------
    InputError
        If the extra is not installed or nobody answers at the address.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--cluster", "Dask is not installed", "pip install 'safevar_sumo[cluster]'") from None
    legal = "the address of a Dask scheduler, such as tcp://host:8786"
    if not ADDRESS.fullmatch(address):
        raise InputError("--cluster", repr(address), legal)
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError("--cluster", f"nobody answers at {address!r}: {error}", legal) from None
    try:
        yield ClusterPool(client)
    finally:
        client.close()


class ClusterPool:
    """Computes batches on a Dask cluster, which itself tries a batch again when a worker dies."""

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(pure=False)
        self._client = client

    @property
    def workers(self) -> int:
        return max(1, int(sum(self._client.nthreads().values())))

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        outer: Future[Evaluations] = Future()
        self._executor.submit(evaluate_batch, study, settings).add_done_callback(lambda done: _hand_on(done, outer))
        return outer


def _hand_on(done: Future[Evaluations], outer: Future[Evaluations]) -> None:
    from distributed import KilledWorker

    if done.cancelled():
        outer.cancel()
        return
    error = done.exception()
    if isinstance(error, KilledWorker):
        outer.set_exception(WorkerLostError(f"workers of the cluster died: {error}"))
    elif error is not None:
        outer.set_exception(error)
    else:
        outer.set_result(done.result())
