"""A small study of three algorithms, in this process or in processes of its own: started, watched, killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.in_process import run

STUDY = """
extends = "smoke"
name = "small"
[search]
algorithms = ["nsga2", "rs", "safe_fuzzer"]
evaluations = 150
"""
WAIT = 60.0
running: list[subprocess.Popen[str]] = []
"""What a test has started."""


def started(*arguments: str, **options: object) -> subprocess.Popen[str]:
    """A command in a process group of its own, as a shell starts it."""
    running.append(subprocess.Popen([sys.executable, "-m", "safevar_sumo", *arguments], stdout=subprocess.PIPE,  # type: ignore[call-overload]
                                    stderr=subprocess.PIPE, text=True, start_new_session=True, **options))
    return running[-1]


def until(condition: Callable[[], bool], process: subprocess.Popen[str] | None = None) -> None:
    """Wait for a condition, or for the end of the process that is to bring it about."""
    end = time.monotonic() + WAIT
    while not condition() and (process is None or process.poll() is None):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def written(out: Path) -> int:
    """How many bytes the journals of the runs have."""
    return sum(path.stat().st_size for path in out.glob("runs/*-*.journal"))


def workers_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The worker processes of a command."""
    try:
        return [child for child in psutil.Process(process.pid).children() if "spawn_main" in " ".join(child.cmdline())]
    except psutil.NoSuchProcess:
        return []


def left_of_group(process: subprocess.Popen[str]) -> list[str]:
    """What still lives of a command's process group."""
    left: list[str] = []
    for one in psutil.process_iter() if os.name == "posix" else ():
        try:
            if os.getpgid(one.pid) == process.pid and one.status() != psutil.STATUS_ZOMBIE:
                left.append(" ".join(one.cmdline()))
        except (psutil.Error, ProcessLookupError):
            continue
    return left


def ended(process: subprocess.Popen[str], expect: int) -> str:
    """Wait for a command's end; returns what it told on stderr."""
    output, errors = process.communicate(timeout=WAIT)
    assert process.returncode == expect, f"{process.returncode}\n{output}\n{errors}"
    assert "Traceback" not in output + errors, errors
    until(lambda: not left_of_group(process))
    return errors


def killed(process: subprocess.Popen[str]) -> None:
    """kill -9."""
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=WAIT)


def study(*arguments: str, expect: int = 0) -> str:
    """Carry the small study out in this process, without a summary; returns what it prints on stderr."""
    return run("study", "small.toml", "--quiet", *arguments, expect=expect).stderr


def solutions(out: str | Path) -> bytes:
    return (Path(out) / "solutions.csv").read_bytes()
