"""A worker in a process of this machine."""

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
"""The signal upon which a worker ends its simulator, and itself; None on Windows."""
ATTEMPTS = "attempts"
"""Name of the folder in which workers note what they simulate."""
CLOSING_TIME = 5.0
"""Time that it has for this [s]; then it is killed."""


Work = Callable[..., Any]
"""What a worker carries out."""


class ProcessWorker:
    """A process that starts at once. It is spawned, because libsumo must not be forked, and ends
    with this process.

    Parameters
    ----------
    last_words
        The file in which the process says where it was when it crashed or exceeded a time limit;
        its name is the worker's number.
    """

    def __init__(self, last_words: Path) -> None:
        self._last_words = last_words
        # Simulators of this process have the number of a worker, too.
        _close_simulators()
        context = multiprocessing.get_context("spawn")
        # The worker's child processes have the mark, too.
        self._mark = uuid4().hex
        arguments = (ImportPath.here(), last_words, self._mark)
        self._executor = ProcessPoolExecutor(1, context, _begin_work, arguments)
        variables = {MARK: self._mark, "PYTHONHASHSEED": "0"}
        # A spawned process would run the main module again; scripts then need no `if __name__ ==
        # "__main__"`.
        hidden_main = {"__main__": ModuleType("__main__")}
        with (
            temporary_entries(sys.modules, hidden_main),
            _show_package(),
            _block_interrupts(),
            temporary_entries(os.environ, variables),
        ):
            # The first job starts the process.
            self._executor.submit(os.getpid)
        (self._process,) = self._executor._processes.values()
        # Otherwise the result of a process that dies while it sends it is waited for until the end
        # of time.
        self._executor._result_queue._writer.close()  # type: ignore[attr-defined]

    def submit(self, function: Work, *arguments: Any) -> Future[Any]:
        return self._executor.submit(function, *arguments)

    def cause_of_death(self, error: BaseException) -> str:
        if not isinstance(error, BrokenExecutor):
            return ""

        # The last words of the worker name the line of user code.
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
        # The executor's thread may have waited for the process, and be about to note its code.
        for _ in range(1000):
            if self._process.exitcode is not None:
                break
            time.sleep(0.001)
        return f"the worker process died (exit code {self._process.exitcode}){place}"

    def end(self) -> None:
        if CLOSING_SIGNAL is not None and self._process.pid:
            # It may have died.
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, CLOSING_SIGNAL)
                self._process.join(CLOSING_TIME)
        self._process.kill()
        end_children(self._mark)
        self._executor.shutdown(cancel_futures=True)


def _begin_work(path: ImportPath, last_words: Path, mark: str) -> None:
    path.inherit()
    for interrupt in INTERRUPTS:
        signal.signal(interrupt, signal.SIG_IGN)
    if CLOSING_SIGNAL is not None:
        signal.signal(CLOSING_SIGNAL, _end_in_order)
    # This folder ends with the pool: a worker is killed, and removes nothing.
    tempfile.tempdir = str(last_words.parent)
    file = open(last_words, "w", encoding="utf-8")  # noqa: SIM115
    faulthandler.enable(file=file, all_threads=False)
    this_process.last_words = file
    this_process.worker = int(last_words.stem)
    this_process.attempts = last_words.parent / ATTEMPTS
    this_process.mark = mark
    threading.Thread(target=_end_with_caller, daemon=True).start()


def _end_in_order(*_: object) -> None:
    """End the simulator of this process, and the process."""
    _close_simulators()
    os._exit(1)


def _close_simulators() -> None:
    if simulators := sys.modules.get("safevar_sumo.sumo.kept"):
        simulators.close_simulator()


def _end_with_caller() -> None:
    """End this process with its caller. Otherwise a worker that hangs in a simulation would outlive
    a killed caller.
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
    """Let a spawned process find this package, even if its folder is not on Python's path."""
    sys.path.append(str(PACKAGE.parent))
    try:
        yield
    finally:
        sys.path.pop()


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block Ctrl-C and the like in this thread: a process that it starts inherits that, and does
    not end while modules load; the one that started it ends it.
    """
    # Windows has no signal masks.
    if sys.platform == "win32":
        yield
        return
    from multiprocessing import resource_tracker

    # A later start would unblock interrupts.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
