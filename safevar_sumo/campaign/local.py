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
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import connection
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from safevar_sumo.campaign.evaluation import Evaluate, evaluate_in_time
from safevar_sumo.campaign.pool import PoolLostError, Report, Share, WorkerLostError, block_interrupts, defer_interrupts
from safevar_sumo.campaign.share import carry_out_share
from safevar_sumo.errors import EnvironmentFault, SafevarError, describe_error
from safevar_sumo.plugins import added_import_folders, inherit_import_folders
from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.records import Evaluations, FloatArray

MAX_START_TIME = 120.0
"""Longest time until a worker process is ready for its first batch [s]."""
START_ATTEMPTS = 5
"""Number of workers in a row that may die before they are ready, which is never the fault of a batch."""
TIMEOUT_MARK = "Timeout ("
"""Begin of what the interpreter writes when a process exceeds its time limit."""
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
        Time limit of a batch [s]; a worker that exceeds it ends.
    """
    with defer_interrupts():
        pool = LocalPool(jobs, time_limit)
        try:
            yield pool
        finally:
            pool.close()


Argument = TypeVar("Argument")
Result = TypeVar("Result")


class LocalPool:
    """Computes batches and carries shares in processes. For each process, a thread of this process waits for its
    messages.

    Workers share no queue and no lock: a worker may die at any moment without harm to the others.
    """

    def __init__(self, jobs: int, time_limit: float) -> None:
        self.workers, self._time_limit = jobs, time_limit
        self._threads = ThreadPoolExecutor(jobs, thread_name_prefix="worker", initializer=block_interrupts)
        self._thread_data = threading.local()
        self._live_workers: set[_Worker] = set()
        self._closed = False

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        return self._start(_evaluate, (work, settings), lambda message: None)

    def carry(self, share: Share, report: Report) -> Future[None]:
        return self._start(carry_out_share, share, report)

    def close(self) -> None:
        """Drop waiting batches and end all workers."""
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        while self._live_workers:
            for worker in list(self._live_workers):
                self._end(worker)
        self._threads.shutdown()

    def _start(self, function: Callable[..., Result], argument: Argument, report: Report) -> Future[Result]:
        try:
            return self._threads.submit(self._call, function, argument, report)
        except RuntimeError:
            raise PoolLostError("the worker processes are closed down") from None

    def _call(self, function: Callable[..., Result], argument: Argument, report: Report) -> Result:
        """Call a function in this thread's worker; if the worker is lost or `report` fails, the worker is ended."""
        worker: _Worker | None = getattr(self._thread_data, "worker", None)
        if worker is None or not worker.alive:
            worker = self._thread_data.worker = self._new_worker()
        try:
            is_answer, answer = worker.call(function, argument)
            while not is_answer:
                report(answer)
                is_answer, answer = worker.receive()
        except BaseException:
            self._end(worker)
            raise
        if isinstance(answer, Exception):
            raise answer
        result: Result = answer
        return result

    def _new_worker(self) -> _Worker:
        for _ in range(START_ATTEMPTS):
            if self._closed:
                raise PoolLostError("the worker processes are closed down")
            worker = _Worker(self._time_limit)
            self._live_workers.add(worker)
            if self._closed:
                worker.end()
            try:
                worker.receive(MAX_START_TIME)
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
    """A process and the pipe to it. The process is spawned, because libsumo must not be forked.

    Its last words are a file: where the process was when it exceeded the time limit of a batch or crashed.
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

    def call(self, function: Callable[..., Result], argument: Argument) -> tuple[bool, Any]:
        """Let the process call a function; returns the first message."""
        with suppress(OSError):  # `receive` notices a dead worker
            self._pipe.send((function, argument))
        return self.receive()

    def receive(self, time_limit: float | None = None) -> tuple[bool, Any]:
        """The process's next message: whether it is the answer to a call, and the answer or report."""
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


def serve(pipe: connection.Connection[Any, Any], folders: list[str], time_limit: float, last_words: str) -> None:
    """The main function of a worker process, which answers calls until the other end of the pipe is closed."""
    inherit_import_folders(folders)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_caller, daemon=True).start()
    with open(last_words, "w", encoding="utf-8") as file, suppress(EOFError, OSError):
        faulthandler.enable(file=file, all_threads=False)
        evaluate = partial(evaluate_in_time, time_limit=time_limit, last_words=file)
        pipe.send((False, None))
        while True:
            function, argument = pipe.recv()
            pipe.send(
                (True, _answer_or_error(function, argument, lambda message: pipe.send((False, message)), evaluate))
            )


def _evaluate(batch: tuple[bytes, FloatArray], report: Report, evaluate: Evaluate) -> Evaluations:
    return evaluate(*batch)


def _answer_or_error(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
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
