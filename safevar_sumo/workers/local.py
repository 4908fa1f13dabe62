"""Computation of batches in worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import connection
from types import ModuleType
from typing import Any

from safevar_sumo.errors import EnvironmentFault, SafevarError, describe_error
from safevar_sumo.plugins import added_import_folders, inherit_import_folders
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.workers.evaluation import PoolLostError, WorkerLostError, evaluate_batch
from safevar_sumo.workers.interrupts import block_interrupts, defer_interrupts

MAX_START_TIME = 120.0
"""Longest time until a worker process is ready for its first batch [s]."""
START_ATTEMPTS = 5
"""Number of workers in a row that may die before they are ready, which is never the fault of a batch."""
_start_lock = threading.Lock()


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_pool(jobs: int, time_limit: float) -> Iterator[LocalPool]:
    """A pool whose worker processes start when they are first needed, and end with the context.

    Parameters
    ----------
    jobs
        Number of worker processes.
    time_limit
        Time limit of a batch [s]; a worker that exceeds it is stopped.
    """
    with defer_interrupts():
        pool = LocalPool(jobs, time_limit)
        try:
            yield pool
        finally:
            pool.close()


class LocalPool:
    """Computes batches in processes. For each process, a thread of this process waits for answers.

    Workers share no queue and no lock: a worker may die at any moment without harm to the others.
    """

    def __init__(self, jobs: int, time_limit: float) -> None:
        self.workers, self._time_limit = jobs, time_limit
        self._threads = ThreadPoolExecutor(jobs, thread_name_prefix="worker", initializer=block_interrupts)
        self._thread_data = threading.local()
        self._live_workers: set[_Worker] = set()
        self._closed = False

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        try:
            return self._threads.submit(self._compute, work, settings)
        except RuntimeError:
            raise PoolLostError("the worker processes are closed down") from None

    def close(self) -> None:
        """Drop waiting batches and end all workers."""
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        while self._live_workers:
            for worker in list(self._live_workers):
                self._end(worker)
        self._threads.shutdown()

    def _compute(self, work: bytes, settings: FloatArray) -> Evaluations:
        worker: _Worker | None = getattr(self._thread_data, "worker", None)
        if worker is None or not worker.alive:
            worker = self._thread_data.worker = self._new_worker()
        try:
            return worker.compute(work, settings, self._time_limit)
        except WorkerLostError:
            self._end(worker)
            self._thread_data.worker = None
            raise

    def _new_worker(self) -> _Worker:
        for _ in range(START_ATTEMPTS):
            if self._closed:
                raise PoolLostError("the worker processes are closed down")
            worker = _Worker()
            self._live_workers.add(worker)
            if self._closed:
                worker.end()
            try:
                worker.wait_until_ready()
            except WorkerLostError as error:
                self._end(worker)
                cause = error
            else:
                return worker
        raise PoolLostError(f"no worker process starts: {cause}")

    def _end(self, worker: _Worker) -> None:
        worker.end()
        self._live_workers.discard(worker)


class _Worker:
    """A process and the pipe to it. The process is spawned, because libsumo must not be forked."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        try:
            self._pipe, worker_end = context.Pipe()
            self._process = context.Process(target=_serve, args=(worker_end, added_import_folders()), daemon=True)
            with _hide_main():
                self._process.start()
        except OSError as error:
            raise PoolLostError(f"no worker process can be started: {error.strerror}") from None
        worker_end.close()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def wait_until_ready(self) -> None:
        """Wait for the first message of the process; raises WorkerLostError without a message."""
        self._receive(MAX_START_TIME, "start")

    def compute(self, work: bytes, settings: FloatArray, time_limit: float) -> Evaluations:
        """Compute a batch; raises the error of the batch, or WorkerLostError."""
        with suppress(OSError):  # `_receive` notices a dead worker
            self._pipe.send((work, settings))
        answer = self._receive(time_limit, "simulation")
        if isinstance(answer, Exception):
            raise answer
        return answer  # type: ignore[no-any-return]

    def _receive(self, time_limit: float, activity: str) -> Any:
        ready = connection.wait([self._pipe, self._process.sentinel], time_limit)
        if not ready:
            raise WorkerLostError(f"the {activity} took longer than {time_limit:g} s")
        with suppress(EOFError, OSError):
            if self._pipe in ready:
                return self._pipe.recv()
        self._process.join()
        raise WorkerLostError(f"the worker process died (exit code {self._process.exitcode})")

    def end(self) -> None:
        """Kill the process; a thread in `_receive` then raises WorkerLostError."""
        self._process.kill()
        self._process.join()


@contextmanager
def _hide_main() -> Iterator[None]:
    """Hide the main module, which a spawned process would run again; scripts then need no `if __name__ == "__main__"`."""
    with _start_lock:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def _serve(pipe: connection.Connection[Any, Any], folders: list[str]) -> None:
    """The main function of a worker process, which answers batches until the other end of the pipe is closed."""
    inherit_import_folders(folders)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_caller, daemon=True).start()
    try:
        pipe.send(None)
        while True:
            pipe.send(_evaluate_or_return_error(*pipe.recv()))
    except (EOFError, OSError):
        return


def _evaluate_or_return_error(work: bytes, settings: FloatArray) -> Evaluations | Exception:
    try:
        return evaluate_batch(work, settings)
    except SafevarError as error:
        return error
    except (OSError, MemoryError) as error:
        return EnvironmentFault(f"a batch cannot be computed: {describe_error(error)}")
    except Exception:
        return RuntimeError(f"in a worker process\n{traceback.format_exc()}")  # not every exception survives the pipe


def _end_with_caller() -> None:
    """End this process with its caller. Otherwise a worker that hangs in a simulation would outlive a killed caller."""
    caller = multiprocessing.parent_process()
    assert caller is not None
    caller.join()
    os._exit(1)
