"""Campaigns and commands in this process: a pool that computes at once, an observer without output, commands as users
type them.
"""

from __future__ import annotations

import io
import json
import os
import sys
from concurrent.futures import Future
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from safevar_sumo.campaign import all_runs, run_campaign
from safevar_sumo.campaign.evaluation import evaluate_batch
from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.campaign.pool import Job, Report
from safevar_sumo.campaign.worker import carry_out_job
from safevar_sumo.cli.program import main
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble


class InlinePool:
    """A pool that computes in this process, at once; it has the interface of a pool of worker processes."""

    workers = 1

    def __init__(self, jobs: int = 1, time_limit: float = 0.0) -> None: ...

    def carry(self, job: Job, report: Report) -> Future[None]:
        future: Future[None] = Future()
        try:
            future.set_result(self.work(job, report))
        except Exception as error:
            future.set_exception(error)
        return future

    def work(self, job: Job, report: Report) -> None:
        carry_out_job(job, report, evaluate_batch)

    def close(self) -> None: ...


class TwoWorkers(InlinePool):
    """A pool in this process whose work is split for two workers."""

    workers = 2


class SilentObserver:
    """An observer that ignores all reports."""

    def progressed(self, *_: object) -> None: ...
    def finished(self, *_: object) -> None: ...
    def warned(self, message: str) -> None: ...


def searched(study: Study, out: Path) -> Path:
    """Search a study in this process; returns its results directory, `out`."""
    results = ResultsDirectory(out, study, identity_of(study, assemble(study)))
    results.finish(run_campaign(study, all_runs(study), results, InlinePool(), SilentObserver()).solutions)
    return out


class CommandOutput(NamedTuple):
    """The text that a command printed."""

    stdout: str
    stderr: str


def run(*arguments: str, expect: int = 0) -> CommandOutput:
    """Run a command as a user types it; its exit code must be `expect`. Afterwards, unload modules that it took from
    the test's folder.
    """
    out, err, code = io.StringIO(), io.StringIO(), None
    loaded_modules = set(sys.modules)
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["safevar-sumo", *arguments])
        patch.setattr(os, "_exit", sys.exit)  # the program calls it if a thread still runs; this process must continue
        try:
            main()
        except SystemExit as end:
            code = end.code
    for name in set(sys.modules) - loaded_modules:
        file = str(getattr(sys.modules[name], "__file__", None) or "")
        if file.startswith(os.getcwd()) and not file.startswith(sys.prefix):
            del sys.modules[name]
    assert code == expect, f"{code}\n{out.getvalue()}\n{err.getvalue()}"
    return CommandOutput(out.getvalue(), err.getvalue())


def json_of(*arguments: str) -> Any:
    """The JSON that a command prints."""
    return json.loads(run(*arguments, "--json").stdout)


def refused(*arguments: str, message: tuple[str, ...]) -> None:
    """The command must end with exit code 2 and print, warnings apart, all of `message` in one or two lines, or a line
    for each mistake.
    """
    output = run(*arguments, expect=2)
    for part in message:
        assert part in output.stderr, output.stderr
    lines = [line for line in output.stderr.strip().splitlines() if not line.startswith("warning: ")]
    assert len(lines) <= 2 or lines[0].endswith("mistakes"), output.stderr
