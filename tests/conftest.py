"""Systems that many tests share, and a cache folder and working directory of their own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import hypothesis
import pytest

from safevar_sumo.study import load_study, study_names
from safevar_sumo.sumo.system import System, assemble
from tests.slippery import make_results

collect_ignore = [] if os.name == "posix" else [
    "workers/test_local_pool.py",
    *(f"end_to_end/test_{name}.py" for name in ("cluster", "faults", "identities", "interruptions", "shares", "worlds_that_fail"))]
"""Tests that kill, stop and interrupt processes as POSIX has it."""

hypothesis.settings.register_profile("default", deadline=None, derandomize=True)
hypothesis.settings.load_profile("default")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Networks are built anew for every session of tests."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


@pytest.fixture(params=study_names())
def any_system(request: pytest.FixtureRequest) -> System:
    """The system of every study that comes with the package, one after the other."""
    system = assemble(load_study(request.param))
    return replace(system, matrix=system.matrix[::30])  # of a long matrix some points


@pytest.fixture
def sun() -> System:
    return assemble(load_study("sun"))


@pytest.fixture
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def slippery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results directory with collisions and near misses."""
    return make_results(tmp_path_factory.mktemp("slippery"))
