"""Workers in processes of this machine."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import connection
from pathlib import Path
from types import ModuleType

from safevar_sumo.campaign.evaluation import Evaluate, evaluate_in_time
from safevar_sumo.campaign.pool import (
    Job,
    Message,
    PoolLostError,
    Report,
    WorkerLostError,
    block_interrupts,
    defer_interrupts,
)
from safevar_sumo.campaign.worker import carry_out_job
from safevar_sumo.errors import EnvironmentFault, SafevarError, describe_error
from safevar_sumo.plugins import added_import_folders, inherit_import_folders
from safevar_sumo.plugins.files import is_user_file

MAX_START_TIME = 120.0
"""Longest time until a worker process is ready for its first batch [s]."""
TIMEOUT_MARK = "Timeout ("
"""What the interpreter writes first when a process exceeds its time limit."""
_start_lock = threading.Lock()


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_pool(workers: int, time_limit: float) -> Iterator[LocalPool]:
    """A pool whose worker processes start when they are first needed, and end with the context.

    Parameters
    ----------
    workers
        Number of worker processes.
    time_limit
        Time limit of a batch [s]; a worker that exceeds it ends.
    """
    with defer_interrupts():
        pool = LocalPool(workers, time_limit)
        try:
            yield pool
        finally:
            pool.close()


class LocalPool:
    """Carries out jobs in worker processes. For each of them, a thread of this process waits for messages.

    Workers share no queue and no lock: a worker may die at any moment without harm to the others.
    """

    def __init__(self, workers: int, time_limit: float) -> None:
        self.workers, self._time_limit = workers, time_limit
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="worker", initializer=block_interrupts)
        self._thread_data = threading.local()
        self._live_workers: set[_Worker] = set()
        self._closed = False

    def carry(self, job: Job, report: Report) -> Future[None]:
        try:
            return self._threads.submit(self._carry, job, report)
        except RuntimeError:
            raise PoolLostError("the worker processes are closed down") from None

    def close(self) -> None:
        """Drop waiting jobs and end all workers."""
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        while self._live_workers:
            for worker in list(self._live_workers):
                self._end(worker)
        self._threads.shutdown()

    def _carry(self, job: Job, report: Report) -> None:
        """Let this thread's worker carry out a job; if the worker is lost or `report` fails, the worker is ended."""
        worker: _Worker | None = getattr(self._thread_data, "worker", None)
        if worker is None or not worker.alive:
            worker = self._thread_data.worker = self._new_worker()
        try:
            worker.send(job)
            while (message := worker.receive()) is not None and not isinstance(message, Exception):
                report(message)
        except BaseException:
            self._end(worker)
            raise
        if message is not None:
            raise message

    def _new_worker(self) -> _Worker:
        worker = _Worker(self._time_limit)
        self._live_workers.add(worker)
        try:
            if self._closed:
                raise PoolLostError("the worker processes are closed down")
            worker.receive(MAX_START_TIME)
        except BaseException:
            self._end(worker)
            raise
        return worker

    def _end(self, worker: _Worker) -> None:
        worker.end()
        self._live_workers.discard(worker)


class _Worker:
    """A process and the pipe to it. The process is spawned, because libsumo must not be forked.

    The file of its last words says where the process was when it exceeded the time limit of a batch or crashed.
    """

    def __init__(self, time_limit: float) -> None:
        self._time_limit, context = time_limit, multiprocessing.get_context("spawn")
        try:
            self._last_words = tempfile.NamedTemporaryFile(prefix="safevar-", suffix=".txt")  # noqa: SIM115
            self._pipe, worker_end = context.Pipe()
            arguments = worker_end, added_import_folders(), time_limit, self._last_words.name
            self._process = context.Process(target=serve, args=arguments, daemon=True)
            with _hide_main():
                self._process.start()
        except OSError as error:
            raise PoolLostError(f"no worker process can be started: {error.strerror}") from None
        worker_end.close()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def send(self, job: Job) -> None:
        """Let the process carry out a job."""
        with suppress(OSError):  # `receive` notices a dead worker
            self._pipe.send(job)

    def receive(self, time_limit: float | None = None) -> Message | Exception | None:
        """The process's next message; None when it is ready for its first job, and after each job without an error."""
        ready = connection.wait([self._pipe, self._process.sentinel], time_limit)
        if not ready:
            raise WorkerLostError(f"the start took longer than {time_limit:g} s")
        with suppress(EOFError, OSError):
            if self._pipe in ready:
                return self._pipe.recv()  # type: ignore[no-any-return]
        self._process.join()
        raise WorkerLostError(self._cause_of_death())

    def end(self) -> None:
        """Kill the process; a thread in `receive` then raises WorkerLostError."""
        self._process.kill()
        self._process.join()

    def _cause_of_death(self) -> str:
        words = Path(self._last_words.name).read_text(encoding="utf-8", errors="replace")
        frames = [(file, line) for file, line in re.findall(r'File "(.+)", line (\d+) in', words) if is_user_file(file)]
        place = f" in {frames[0][0]}, line {frames[0][1]}" if frames else ""
        if TIMEOUT_MARK in words:
            return f"the simulation took longer than {self._time_limit:g} s{place}"
        return f"the worker process died (exit code {self._process.exitcode}){place}"


@contextmanager
def _hide_main() -> Iterator[None]:
    """Hide the main module, which a spawned process would run again; scripts then need no `if __name__ ==
    "__main__"`.
    """
    with _start_lock:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def serve(
    pipe: connection.Connection[Message | Exception | None, Job], folders: list[str], time_limit: float, last_words: str
) -> None:
    """The main function of a worker process, which carries out jobs until the other end of the pipe is closed."""
    inherit_import_folders(folders)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_caller, daemon=True).start()
    with open(last_words, "w", encoding="utf-8") as file, suppress(EOFError, OSError):
        faulthandler.enable(file=file, all_threads=False)
        evaluate = partial(evaluate_in_time, time_limit=time_limit, last_words=file)
        pipe.send(None)
        while True:
            job = pipe.recv()
            pipe.send(_error_of(job, pipe.send, evaluate))


def _error_of(job: Job, report: Report, evaluate: Evaluate) -> Exception | None:
    """Carry out a job; returns the error that ends it."""
    try:
        carry_out_job(job, report, evaluate)
    except SafevarError as error:
        return error
    except (OSError, MemoryError) as error:
        return EnvironmentFault(f"a batch cannot be computed: {describe_error(error)}")
    except Exception:
        return RuntimeError(f"in a worker process\n{traceback.format_exc()}")  # not every exception survives the pipe
    return None


def _end_with_caller() -> None:
    """End this process with its caller. Otherwise a worker that hangs in a simulation would outlive a killed caller."""
    caller = multiprocessing.parent_process()
    assert caller is not None
    caller.join()
    os._exit(1)
