"""Batches computed by processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Future, TimeoutError
from contextlib import contextmanager

from pebble import ProcessExpired, ProcessPool

from safevar_sumo.computing.base import WorkerLostError, evaluate_batch
from safevar_sumo.records import Evaluations, FloatArray


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_pool(jobs: int, time_limit: float) -> Iterator[LocalPool]:
    """Worker processes, spawned: libsumo must not be forked. They end with the block.

    Parameters
    ----------
    jobs
        How many worker processes.
    time_limit
        A batch that takes longer is stopped [s].
    """
    pool = ProcessPool(max_workers=jobs, context=multiprocessing.get_context("spawn"), initializer=_leave_interrupts_to_the_caller)
    try:
        yield LocalPool(pool, jobs, time_limit)
        pool.close()
    finally:
        pool.stop()
        pool.join()


class LocalPool:
    """Computes batches in the processes of a Pebble pool, which outlives its workers' deaths."""

    def __init__(self, pool: ProcessPool, jobs: int, time_limit: float) -> None:
        self._pool, self.workers, self._time_limit = pool, jobs, time_limit

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        inner = self._pool.schedule(evaluate_batch, args=(study, settings), timeout=self._time_limit)
        outer: Future[Evaluations] = Future()
        inner.add_done_callback(lambda done: self._hand_on(done, outer))
        return outer

    def _hand_on(self, done: Future[Evaluations], outer: Future[Evaluations]) -> None:
        if done.cancelled():
            outer.cancel()
            return
        error = done.exception()
        if isinstance(error, ProcessExpired):
            outer.set_exception(WorkerLostError(f"the worker process died (exit code {error.exitcode})"))
        elif isinstance(error, TimeoutError):
            outer.set_exception(WorkerLostError(f"the simulation took longer than {self._time_limit:g} s"))
        elif error is not None:
            outer.set_exception(error)
        else:
            outer.set_result(done.result())


def _leave_interrupts_to_the_caller() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
