"""Commands in processes of their own, which are looked at, stopped and killed."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil

TIMEOUT = 60.0  # s
Process = subprocess.Popen[str]
running = list[Process]()
"""Processes that a test has started."""


def started(typed: str, batch: int | None = None, **options: object) -> Process:
    """Start a command in its own process group and with Ctrl-C as a shell does, whatever this
    process ignores; with `batch`, in batches of at most so many settings.
    """
    program = ["-m", "safevar_sumo"] if batch is None else [__file__, str(batch)]
    running.append(
        subprocess.Popen(
            [sys.executable, *program, *shlex.split(typed)],
            stdout=subprocess.PIPE,  # type: ignore[call-overload]
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # Only this test's own thread starts processes.
            preexec_fn=None if os.name == "nt" else _heed_signals,  # noqa: PLW1509
            **options,
        )
    )
    return running[-1]


def _heed_signals() -> None:
    """Let this process end by Ctrl-C, and when its terminal is lost."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def until(condition: Callable[[], bool], process: Process | None = None) -> None:
    """Wait for a condition, or for the end of the process that should fulfil it."""
    deadline = time.monotonic() + TIMEOUT
    while not condition() and (process is None or process.poll() is None):
        assert time.monotonic() < deadline, "the condition was not fulfilled in time"
        time.sleep(0.01)


def written(out: Path) -> int:
    """Number of bytes in the journals of the runs."""
    return sum(path.stat().st_size for path in out.glob("runs/*-*.jsonl"))


def workers_of(process: int) -> list[psutil.Process]:
    """The worker processes of a process."""
    try:
        return [
            child
            for child in psutil.Process(process).children()
            if "spawn_main" in " ".join(child.cmdline())
        ]
    except psutil.NoSuchProcess:
        return []


def has_loaded(process: Process, library: str) -> bool:
    """Whether a process has loaded a library."""
    files = psutil.Process(process.pid).memory_maps()
    return any(library in file.path for file in files)


def left_of_group(process: Process) -> list[str]:
    """Command lines of the processes in a command's process group that still run."""
    command_lines = []
    for member in psutil.process_iter() if os.name == "posix" else ():
        try:
            if (
                os.getpgid(member.pid) == process.pid
                and member.status() != psutil.STATUS_ZOMBIE
            ):
                command_lines.append(" ".join(member.cmdline()))
        except (psutil.Error, ProcessLookupError):
            continue
    return command_lines


def ended(process: Process, expect: int) -> str:
    """Wait for a command's end; returns its text on stderr."""
    output, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == expect, f"{process.returncode}\n{output}\n{errors}"
    assert "Traceback" not in output + errors, errors
    until(lambda: not left_of_group(process))
    return errors


def killed(process: Process) -> None:
    """Kill a process with SIGKILL."""
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=TIMEOUT)
    until(lambda: not left_of_group(process))


def run_in_batches(size: int) -> None:
    """Run the program in this process with batches of at most so many settings: a study takes
    longer, and can be interrupted at more places.
    """
    from safevar_sumo.campaign import campaign
    from safevar_sumo.cli.program import run_command_line

    campaign.efficient_batch = lambda system: size  # type: ignore[attr-defined]
    run_command_line()


if __name__ == "__main__":
    run_in_batches(int(sys.argv.pop(1)))
