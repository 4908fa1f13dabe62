"""Fixtures for many tests: systems, results, an own cache folder and working directory, and where
pools compute.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import hypothesis
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import local
from safevar_sumo.plugins import ImportPath
from safevar_sumo.questions import cases, repair
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.case import Results, load_cases
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import explain
from safevar_sumo.questions.repair import survivors
from safevar_sumo.questions.tolerance import asked
from safevar_sumo.sumo.system import System
from tests.support import in_process, planted_sled
from tests.support.in_process import (
    EVERY_STUDY,
    InlinePool,
    allow_few_simulations,
    searched,
)
from tests.support.made_up import FITS, system_of
from tests.support.report_pages import draw_few_frames

collect_ignore = (
    []
    if os.name == "posix"
    else ["campaign/test_pool.py", "end_to_end/test_processes.py"]
)
"""Tests that send POSIX signals to processes; other systems skip them."""

hypothesis.settings.register_profile("default", deadline=None, derandomize=True)
hypothesis.settings.load_profile("default")
# Programs that tests start, and the next session, need not compile everything each time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
SLIPPERY = """
extends = "smoke"
name = "slippery"
title = "Crossing on wet leaves"
[scenario]
margin = 0.3
over = false
[weather]
name = "wet leaves"
road_friction = 0.75
visibility = 1.0
recognition_delay = 0.15
[search]
algorithms = ["nsga2", "rs"]
population = 8
evaluations = 56
runs = 1
"""


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Each session of tests builds its own networks, once for all of its processes. It keeps no
    simulations, by which a test would check itself.
    """
    session = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        session = session.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(session / "cache"))
        patch.setenv("SAFEVAR_CACHE", "off")
        yield


@pytest.fixture(autouse=True)
def _own_import_path() -> Iterator[None]:
    """Folders of one test's user code are on the path of no other, also where the test changes the
    path itself.
    """
    path = ImportPath.here()
    yield
    path.inherit()


@pytest.fixture
def pools_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pools that the library opens start no worker processes."""
    monkeypatch.setattr(local, "ProcessWorker", in_process.inline_worker)


@pytest.fixture
def worker_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that a test runs in this process start worker processes, as for a user."""
    monkeypatch.setattr(in_process, "worker_of_commands", local.ProcessWorker)


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Questions scan 20 values of a characteristic, and their indices come from 64 points: enough
    where a test is about what is said, and with which settings.
    """
    monkeypatch.setattr("safevar_sumo.questions.indices.BASE_POINTS", 64)
    monkeypatch.setattr(asked, "USUAL", asked.USUAL._replace(values=10))


@pytest.fixture
def few_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    allow_few_simulations(monkeypatch)


@pytest.fixture
def few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_few_frames(monkeypatch)


@pytest.fixture(params=EVERY_STUDY)
def any_system(request: pytest.FixtureRequest) -> System:
    """The system of each shipped study in turn."""
    system = system_of(request.param)
    return replace(
        system, points=system.points[::30]
    )  # only some points of a long matrix


@pytest.fixture
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def slippery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a small study on wet leaves: collisions and near misses among 20 solutions."""
    folder = tmp_path_factory.mktemp("slippery")
    (folder / "slippery.toml").write_text(SLIPPERY)
    study = load_study(str(folder / "slippery.toml"))
    sets = {name: values[:FITS] for name, values in study.spread.items()}
    return searched(load_study(study, spread=sets), folder / "results")


@pytest.fixture(scope="session")
def case(slippery: Path) -> Results:
    """These results as a case."""
    return load_cases([slippery])[0]


@pytest.fixture(scope="session")
def explained(case: Results) -> Answer:
    """Explanations of the failures in the results `slippery`."""
    return explain.compute(case, Evaluator(case.study, InlinePool()), top=3)


@pytest.fixture
def quick_repairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A repair is searched with few simulations, and proved for 99 % of all vehicles."""
    monkeypatch.setattr(cases, "USUAL_BUDGET", 300)
    monkeypatch.setattr(repair, "SOBOL_VEHICLES", 32)
    monkeypatch.setattr(survivors, "MAX_SHARE_REPAIRED", 0.01)


@pytest.fixture
def planted(tmp_path: Path, quick_repairs: None) -> Path:
    """The study of a sled with the planted parameters."""
    (tmp_path / "models.py").write_text(planted_sled.MODELS)
    (tmp_path / "planted.toml").write_text(planted_sled.STUDY)
    return tmp_path / "planted.toml"
