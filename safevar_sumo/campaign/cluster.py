"""Workers of a Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import logging
import os
import pickle
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.metadata import version
from typing import Any
from uuid import uuid4

from safevar_sumo.campaign.evaluation import Evaluate, evaluate_in_time
from safevar_sumo.campaign.pool import Message, PoolLostError, Report, Share, WorkerLostError, defer_interrupts
from safevar_sumo.campaign.share import carry_out_share
from safevar_sumo.errors import InputError, SafevarError, describe_error
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import RESULTS

CLUSTER = (
    "the address of a Dask scheduler, such as tcp://host:8786; for tls:// certificates in Dask's configuration: "
    "distributed.comm.tls.ca-file and .client.cert, .client.key"
)
CONNECT_TIMEOUT = 10.0
"""Longest time for the scheduler to answer [s]."""
SECONDS_BETWEEN_LOOKS = 0.5
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
    """Computes batches and carries shares on a Dask cluster; Dask repeats what a dead worker did."""

    def __init__(self, client: Any, time_limit: float) -> None:
        self._executor = client.get_executor(pure=False)
        self._client, self._time_limit = client, time_limit

    @property
    def workers(self) -> int:
        """Number of worker processes; each computes one batch at a time."""
        try:
            return max(1, len(self._client.nthreads()))
        except (OSError, TimeoutError) as error:
            raise PoolLostError(f"the cluster does not answer any more: {error}") from None

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        self._submit(_evaluate, (self._time_limit, _versions(), work, settings)).add_done_callback(
            lambda dask_future: _forward_result(dask_future, future)
        )
        return future

    def carry(self, share: Share, report: Report) -> Future[None]:
        from distributed import Queue

        future: Future[None] = Future()
        name = f"safevar-{uuid4()}"
        messages = Queue(name, client=self._client)
        dask_future = self._submit(_carry, (self._time_limit, _versions(), share, name))

        def pass_on_messages() -> None:
            try:
                while not dask_future.done() or messages.qsize():
                    with suppress(TimeoutError):
                        report(pickle.loads(messages.get(timeout=SECONDS_BETWEEN_LOOKS)))
            except Exception as error:
                dask_future.cancel()
                future.set_exception(
                    error if isinstance(error, SafevarError) else PoolLostError("the cluster does not answer any more")
                )
            else:
                _forward_result(dask_future, future)

        threading.Thread(target=pass_on_messages, daemon=True).start()
        return future

    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Future[Any]:
        try:
            return self._executor.submit(function, *arguments)  # type: ignore[no-any-return]
        except RuntimeError as error:
            raise PoolLostError(f"the cluster does not answer any more: {error}") from None


def _evaluate(time_limit: float, versions: dict[str, str], work: bytes, settings: FloatArray) -> Evaluations:
    """Evaluate a batch in a worker."""
    with _evaluator(time_limit, versions) as evaluate:
        return evaluate(work, settings)


def _carry(time_limit: float, versions: dict[str, str], share: Share, queue: str) -> None:
    """Carry out a share in a worker; it ends at its next message if the campaign is gone."""
    from distributed import Queue, get_worker

    worker, messages = get_worker(), Queue(queue)
    task = worker.state.tasks[worker.get_current_task()]

    def report(message: Message) -> None:
        if task.state == "cancelled":
            raise PoolLostError("the campaign is gone")
        messages.put(pickle.dumps(message))  # Dask's own serialization turns records into lists

    with _evaluator(time_limit, versions) as evaluate:
        carry_out_share(share, report, evaluate)


@contextmanager
def _evaluator(time_limit: float, versions: dict[str, str]) -> Iterator[Evaluate]:
    """The function that evaluates batches in a worker, one at a time because a process has one libsumo; a worker that
    hangs ends.
    """
    if _versions() != versions:
        raise PoolLostError(f"a worker of the cluster has other versions: {_versions()} there, {versions} here")
    with _libsumo_lock, open(os.devnull, "w") as null_file:
        yield partial(evaluate_in_time, time_limit=time_limit, last_words=null_file)


@cache
def _versions() -> dict[str, str]:
    return {**{name: version(name) for name in VERSIONED_PACKAGES}, "results": str(RESULTS)}


def _forward_result(dask_future: Future[Any], future: Future[Any]) -> None:
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
