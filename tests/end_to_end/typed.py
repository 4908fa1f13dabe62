"""The program as typed, in this process: what it starts no other for need not wait for imports."""

from __future__ import annotations

import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

import pytest

from safevar_sumo.cli.program import main


class Done(NamedTuple):
    stdout: str
    stderr: str


def run_here(*arguments: str, expect: int = 0) -> Done:
    """Run a command; its exit code must be the one expected. Modules of a test's own folder are forgotten again."""
    out, err, code = io.StringIO(), io.StringIO(), None
    before = set(sys.modules)
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["safevar-sumo", *arguments])
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


def refused(*arguments: str, told: tuple[str, ...]) -> None:
    """The command ends with exit code 2 and one or two lines that tell all of `told`, or a line for each of several mistakes."""
    done = run_here(*arguments, expect=2)
    for part in told:
        assert part in done.stderr, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) <= 2 or lines[0].startswith("Usage:") or lines[0].endswith("mistakes"), done.stderr
