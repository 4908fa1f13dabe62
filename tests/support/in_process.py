"""Campaigns and commands in this process: a pool that computes at once, commands as users type
them; and Python in a new process.
"""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from safevar_sumo.campaign import all_runs, evaluation, local, run_campaign
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.cli.program import COMMANDS, command_function, run_command_line
from safevar_sumo.errors import INTERRUPTS
from safevar_sumo.questions import cases
from safevar_sumo.questions.answer import Contents, contents_of
from safevar_sumo.questions.tolerance import asked
from safevar_sumo.records import FloatArray
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import Study, study_names
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.verification import verify_in_sumo
from safevar_sumo.terminal import show_no_progress
from tests.support.made_up import MISSING
from tools.manual import PROGRAM

SLOW = pytest.mark.slow
LONG = [
    "alks",
    "autoware_december",
    "euro_ncap_pedestrian",
    "fmvss127",
    "lgsvl",
    "r152_laden",
    "sensing",
    "wear_idm",
    "wear_realistic",
    "wear_rss",
]
EVERY_STUDY = [
    pytest.param(name, marks=SLOW if name in LONG else ())
    for name in study_names()
    if name not in MISSING
]
"""Shipped studies whose extras are installed; those that take long are slow."""


class InlinePool(Pool):
    """A pool that computes in this process, at once, and is its own worker."""

    def __init__(self, workers: int = 1) -> None:
        super().__init__(workers, lambda place: self)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future = Future[Any]()
        try:
            future.set_result(self.compute(function, *arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return function(*arguments)

    def cause_of_death(self, error: BaseException) -> str:
        return ""

    def end(self) -> None: ...


def inline_worker(last_words: Path) -> InlinePool:
    """A worker in this process, which knows as little as a new one."""
    evaluation._assemble_packed.cache_clear()
    return InlinePool()


worker_of_commands: Callable[[Path], Any] = inline_worker
"""Starts a worker of a command that a test runs in this process."""


def write(name: str, text: str) -> None:
    """Write a file in the working directory, as a user does."""
    Path(name).write_text(text)


def rewrite(file: Path, *changes: tuple[str, str]) -> None:
    """Replace texts that a file has."""
    text = file.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)


def own_network(folder: Path, shipped: str = "pedestrian_crossing") -> Path:
    """Copy a shipped network to a folder, as a user does; returns the folder."""
    return Path(shutil.copytree(NETWORKS / shipped, folder))


def searched(study: Study, out: Path) -> Path:
    """Search a study in this process; returns its results directory, `out`."""
    run_campaign(
        study,
        assemble(study),
        all_runs(study),
        out,
        InlinePool(),
        show_no_progress,
    )
    return out


def verify_everywhere(system: System, settings: FloatArray) -> None:
    """Verify settings, shape (M, n), in SUMO at every point."""
    for point in system.points:
        assert not verify_in_sumo(
            system.at(point), settings, np.zeros(len(settings), dtype=int)
        )


def allow_few_simulations(patch: pytest.MonkeyPatch) -> None:
    """Claims are falsified with the fewest simulations that are enough to print them."""
    least = cases.LEAST_SIMULATIONS
    patch.setattr(cases, "USUAL_BUDGET", least)
    patch.setattr(asked, "USUAL", asked.USUAL._replace(cases=least, alone=least))


class CommandOutput(NamedTuple):
    """The text that a command printed."""

    stdout: str
    stderr: str


def run(typed: str, *arguments: str, expect: int | None = 0) -> CommandOutput:
    """Run a command as a user types it, with further arguments, and its workers in this process;
    its exit code must be `expect`, unless that is None. Afterwards, unload modules that it took
    from the test's folder.
    """
    out = io.StringIO()
    err = io.StringIO()
    code = None
    # a command that fails ignores Ctrl-C, and so would later processes
    handlers = {one: signal.getsignal(one) for one in INTERRUPTS}
    loaded_modules = set(sys.modules)
    with (
        redirect_stdout(out),
        redirect_stderr(err),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(local, "ProcessWorker", worker_of_commands)
        patch.setattr(sys, "argv", ["safevar-sumo", *shlex.split(typed), *arguments])
        patch.setattr(
            os, "_exit", sys.exit
        )  # the program calls it if a thread still runs; this process must continue
        try:
            run_command_line()
        except SystemExit as end:
            code = end.code
    for one, handler in handlers.items():
        signal.signal(one, handler)
    for name in set(sys.modules) - loaded_modules:
        file = str(getattr(sys.modules[name], "__file__", None) or "")
        if file.startswith(os.getcwd()) and not file.startswith(sys.prefix):
            del sys.modules[name]
    assert expect is None or code == expect, (
        f"{code}\n{out.getvalue()}\n{err.getvalue()}"
    )
    return CommandOutput(out.getvalue(), err.getvalue())


def run_python(*arguments: str, expect: int = 0, **options: Any) -> CommandOutput:
    """Run Python with these arguments in a new process; its exit code must be `expect`."""
    done = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        **options,
    )
    assert done.returncode == expect, done.stderr
    return CommandOutput(done.stdout, done.stderr)


def json_of(typed: str, *arguments: str, expect: int = 0) -> Any:
    """The JSON that a command prints. A question has declared all names in it."""
    answer = json.loads(run(typed, *arguments, "--json", expect=expect).stdout)
    if answer["question"] in COMMANDS:
        declared = contents_of(command_function(answer["question"]))
        assert declared is not None
        tables = {
            name: list(table["columns"]) for name, table in answer["tables"].items()
        }
        for key in Contents(answer["numbers"], tables).keys:
            declared.check_key(key)
    return answer


def rows_of(answer: Any, table: str) -> Any:
    """The rows of a table of an answer's JSON."""
    return answer["tables"][table]["rows"]


def numbers_of(command: str) -> Any:
    """The numbers of a command, typed or printed."""
    return json_of(command.removeprefix(PROGRAM))["numbers"]


def refused(typed: str, *message: str) -> None:
    """The command must end with exit code 2 and print, warnings, notes and progress apart, all of
    `message` in one or two lines that are not too long, or a line for each mistake.
    """
    output = run(typed, expect=2)
    for part in message:
        assert part in output.stderr, output.stderr
    assert "Traceback" not in output.stderr
    apart = re.compile(r"warning: |note: |.* left|.*: [\d,]+ of [\d,]+$")
    lines = [
        line for line in output.stderr.strip().splitlines() if not apart.match(line)
    ]
    assert len(lines) <= 2 or lines[0].endswith("mistakes"), output.stderr
    assert max(map(len, lines)) < 1000, output.stderr
