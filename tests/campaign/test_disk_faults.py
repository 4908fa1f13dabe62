"""Every step on the disk fails once: a campaign ends with an error that it tells, and goes on to the same bytes."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from safevar_sumo import output
from safevar_sumo.campaign import all_runs, run_campaign
from safevar_sumo.errors import SafevarError
from safevar_sumo.results import ResultsDirectory, journal, load_runs, manifest
from safevar_sumo.study import Study, load_study
from tests.campaign.formulas import EventLog, FormulaPool

KINDS = (errno.EIO, errno.ENOSPC, errno.EINTR, 0)
"""Errors that a step fails with; 0 is a write of half of what was to be written, and no error elsewhere."""
MOST_STEPS = 500


class Disk:
    """Lets the `fails`-th step on the disk fail, and with `stays` all after it."""

    def __init__(self, fails: int, kind: int, *, stays: bool = False) -> None:
        self._fails, self._kind, self._stays, self.steps = fails, kind, stays, 0

    def step(self) -> bool:
        """One step; raises if it fails, or tells that it is to be done by half."""
        self.steps += 1
        if self.steps == self._fails or (self._stays and self.steps > self._fails):
            if self._kind:
                raise OSError(self._kind, os.strerror(self._kind))
            return True
        return False

    def failing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any, **options: Any) -> Any:
            self.step()
            return function(*arguments, **options)

        return called

    def open(self, *arguments: Any, **options: Any) -> Any:
        self.step()
        return File(open(*arguments, **options), self)


class File:
    """A file whose steps may fail."""

    def __init__(self, inner: Any, disk: Disk) -> None:
        self._inner, self._disk = inner, disk

    def write(self, content: Any) -> int:
        half = self._disk.step() and isinstance(content, memoryview) and len(content) > 1
        return int(self._inner.write(content[: len(content) // 2] if half else content))

    def truncate(self, size: int) -> int:
        self._disk.step()
        return int(self._inner.truncate(size))

    def __enter__(self) -> File:
        return self

    def __exit__(self, *_: object) -> None:
        self._inner.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


@pytest.fixture(scope="module")
def tiny() -> Study:
    smoke = load_study("smoke")
    search = msgspec.structs.replace(smoke.search, algorithms=["nsga2", "rs"], population=10, evaluations=20, runs=1)
    return msgspec.structs.replace(smoke, search=search)


def carried_out(study: Study, path: Path) -> bytes:
    results = ResultsDirectory(path, study)
    results.finish(run_campaign(study, all_runs(study), results, FormulaPool(), EventLog()).solutions)
    return (path / "solutions.csv").read_bytes()


def broken(study: Study, path: Path, disk: Disk) -> bool:
    """Carry the study out on a disk that fails; whether it ended with an error."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (manifest, journal, output):
            patch.setattr(module, "open", disk.open, raising=False)
        for name in ("fsync", "replace", "mkdir", "open", "unlink"):
            patch.setattr(os, name, disk.failing(getattr(os, name)))
        try:
            carried_out(study, path)
        except SafevarError:
            return True
        return False


@pytest.mark.slow
@pytest.mark.parametrize("stays", [False, True])
def test_every_step_on_the_disk_may_fail(stays: bool, tiny: Study, tmp_path: Path) -> None:
    expected, errors = carried_out(tiny, tmp_path / "whole"), 0
    for number in range(1, MOST_STEPS):
        disk = Disk(number, KINDS[number % len(KINDS)], stays=stays)
        out = tmp_path / str(number)
        failed = broken(tiny, out, disk)
        errors += failed
        if (out / "manifest.json").exists():
            load_runs(out)
        if not failed:
            assert (out / "solutions.csv").read_bytes() == expected
        assert carried_out(tiny, out) == expected
        assert not [path for path in out.rglob("*.tmp*") if not failed]
        if disk.steps < number:
            break
    assert number < MOST_STEPS - 1, "no step is left that has not failed"
    assert errors > 15
