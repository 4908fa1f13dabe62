"""A worker of a pool that is a process of this machine."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any
from uuid import uuid4

from safevar_sumo.errors import INTERRUPTS
from safevar_sumo.plugins import ImportPath
from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.plugins.process import (
    CLOSED,
    MARK,
    REPRODUCED_BY,
    end_children,
    temporary_entries,
    this_process,
)
from safevar_sumo.plugins.time_limit import TIMEOUT_MARK
from safevar_sumo.shipped import PACKAGE

CLOSING_SIGNAL = getattr(signal, "SIGUSR1", None)
"""The signal after which a worker ends its simulator and then itself; None on Windows."""
ATTEMPTS = "attempts"
"""The name of the folder in which workers note the settings that they simulate."""
CLOSING_TIME = 5.0
"""The time that a worker has to end its simulator [s]. Then the worker is killed."""


Work = Callable[..., Any]
"""A function that a worker carries out."""


class ProcessWorker:
    """A worker process. It starts at once, and ends with this process. The process is spawned,
    because libsumo must not be forked.

    Parameters
    ----------
    last_words
        The file in which the process notes its place in the code when it crashes or exceeds a time
        limit. The name of the file is the worker's number.
    """

    def __init__(self, last_words: Path) -> None:
        self._last_words = last_words
        # A simulator that this process has opened uses the number of a worker: it must end first.
        _close_simulators()
        context = multiprocessing.get_context("spawn")
        # Child processes of the worker inherit the mark, by which they can be found and ended.
        self._mark = uuid4().hex
        arguments = (ImportPath.here(), last_words, self._mark)
        self._executor = ProcessPoolExecutor(1, context, _begin_work, arguments)
        variables = {MARK: self._mark, "PYTHONHASHSEED": "0"}
        # A spawned process would run the user's main module again. Without a main module, scripts
        # need no `if __name__ == "__main__"`.
        hidden_main = {"__main__": ModuleType("__main__")}
        with (
            temporary_entries(sys.modules, hidden_main),
            _show_package(),
            _block_interrupts(),
            temporary_entries(os.environ, variables),
        ):
            # The executor starts its process with the first job.
            self._executor.submit(os.getpid)
        (self._process,) = self._executor._processes.values()  # noqa: SLF001 - no public name
        # If a process dies while it sends a result, the reader waits for the rest until all writers
        # are closed. This process holds a writer, too: without the call it would wait for ever.
        self._executor._result_queue._writer.close()  # type: ignore[attr-defined]  # noqa: SLF001 - no public name

    def submit(self, function: Work, *arguments: Any) -> Future[Any]:
        return self._executor.submit(function, *arguments)

    def cause_of_death(self, error: BaseException) -> str:
        if not isinstance(error, BrokenExecutor):
            return ""

        # The last words of the worker may name the line of user code at which it died.
        self._process.join()
        words = ""
        if self._last_words.exists():
            words = self._last_words.read_text(encoding="utf-8", errors="replace")
        place = ""
        for file, line in re.findall(r'File "(.+)", line (\d+) in', words):
            if is_user_file(file):
                place = f" in {file}, line {line}"
                break
        first_line = words.partition("\n")[0]
        if first_line.startswith(REPRODUCED_BY):
            place += first_line
        if CLOSED in words:
            return f"{CLOSED}{place}"
        if TIMEOUT_MARK in words:
            return (
                f"a batch took longer than the time limit, `search.time_limit`{place}"
            )
        # The executor's own thread may just have noticed the end of the process, without having set
        # its exit code yet.
        for _ in range(1000):
            if self._process.exitcode is not None:
                break
            time.sleep(0.001)
        return f"the worker process died (exit code {self._process.exitcode}){place}"

    def end(self) -> None:
        if CLOSING_SIGNAL is not None and self._process.pid:
            # The process may have died already.
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, CLOSING_SIGNAL)
                self._process.join(CLOSING_TIME)
        self._process.kill()
        end_children(self._mark)
        self._executor.shutdown(cancel_futures=True)


def _begin_work(path: ImportPath, last_words: Path, mark: str) -> None:
    """Prepare this process, a new worker: import path, signals, files for its last words."""
    path.inherit()
    for interrupt in INTERRUPTS:
        signal.signal(interrupt, signal.SIG_IGN)
    if CLOSING_SIGNAL is not None:
        # This process has inherited that interrupts are blocked.
        signal.signal(CLOSING_SIGNAL, _end_in_order)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [CLOSING_SIGNAL])
    # The pool removes this folder at its end. A killed worker could not remove its own files.
    tempfile.tempdir = str(last_words.parent)
    file = open(last_words, "w", encoding="utf-8")  # noqa: SIM115 - closed with the process
    faulthandler.enable(file=file, all_threads=False)
    this_process.last_words = file
    this_process.worker = int(last_words.stem)
    this_process.attempts = last_words.parent / ATTEMPTS
    this_process.mark = mark
    threading.Thread(target=_end_with_caller, daemon=True).start()


def _end_in_order(*_: object) -> None:
    """End the simulator of this process, and then the process."""
    _close_simulators()
    os._exit(1)


def _close_simulators() -> None:
    if simulators := sys.modules.get("safevar_sumo.sumo.kept"):
        simulators.close_simulator()


def _end_with_caller() -> None:
    """End this process when its caller ends. Otherwise a worker that hangs in a simulation would
    outlive a killed caller.
    """
    caller = multiprocessing.parent_process()
    assert caller is not None
    caller.join()
    if CLOSING_SIGNAL is not None:
        os.kill(os.getpid(), CLOSING_SIGNAL)
        time.sleep(CLOSING_TIME)
    os._exit(1)


@contextmanager
def _show_package() -> Iterator[None]:
    """Within the block, processes that start can import this package, even if its folder is not on
    Python's path.
    """
    sys.path.append(str(PACKAGE.parent))
    try:
        yield
    finally:
        sys.path.pop()


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block Ctrl-C and similar signals in this thread. A process that starts within the block
    inherits the blocked signals: it does not end while its modules load. The process that started
    it ends it.
    """
    # Windows has no masks of signals.
    if sys.platform == "win32":
        yield
        return
    from multiprocessing import resource_tracker

    # If the resource tracker started later, it would unblock the signals.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
