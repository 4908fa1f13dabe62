"""A campaign's surroundings in this process: a pool that computes at once, an observer that nobody hears, commands as typed."""

from __future__ import annotations

import io
import os
import sys
from concurrent.futures import Future
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from safevar_sumo.campaign import all_runs, run_campaign
from safevar_sumo.cli.program import main
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.evaluation import evaluate_batch
from safevar_sumo.workers.identity import identity_of


class Here:
    """A pool that computes in this process, at once; takes what a pool of worker processes takes."""

    workers = 1

    def __init__(self, jobs: int = 1, time_limit: float = 0.0) -> None: ...

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        try:
            future.set_result(evaluate_batch(work, settings))
        except Exception as error:
            future.set_exception(error)
        return future

    def close(self) -> None: ...


class Silent:
    """An observer that nobody hears."""

    def evaluated(self, *_: object) -> None: ...
    def finished(self, *_: object) -> None: ...
    def warned(self, message: str) -> None: ...


def searched(study: Study, out: Path) -> Path:
    """Carry a study out in this process; returns its results directory, `out`."""
    results = ResultsDirectory(out, study, identity_of(study, assemble(study)))
    results.finish(run_campaign(study, all_runs(study), results, Here(), Silent()).solutions)
    return out


class Done(NamedTuple):
    """What a command printed."""

    stdout: str
    stderr: str


def run(*arguments: str, expect: int = 0) -> Done:
    """Run a command as typed; its exit code must be the one expected. Modules of a test's own folder are forgotten again."""
    out, err, code = io.StringIO(), io.StringIO(), None
    before = set(sys.modules)
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["safevar-sumo", *arguments])
        patch.setattr(os, "_exit", sys.exit)  # which the program calls where a thread is left: this process is to live on
        try:
            main()
        except SystemExit as end:
            code = end.code
    for name in set(sys.modules) - before:
        file = str(getattr(sys.modules[name], "__file__", None) or "")
        if file.startswith(os.getcwd()) and not file.startswith(sys.prefix):
            del sys.modules[name]
    assert code == expect, f"{code}\n{out.getvalue()}\n{err.getvalue()}"
    return Done(out.getvalue(), err.getvalue())


def refused(*arguments: str, message: tuple[str, ...]) -> None:
    """The command ends with exit code 2 and, warnings apart, one or two lines that tell all of `message`, or a line for each mistake."""
    done = run(*arguments, expect=2)
    for part in message:
        assert part in done.stderr, done.stderr
    lines = [line for line in done.stderr.strip().splitlines() if not line.startswith("warning: ")]
    assert len(lines) <= 2 or lines[0].endswith("mistakes"), done.stderr
