"""What SUMO repeats of a search, and that it finds a fault of the fast engine in any test."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api import study as command
from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import all_runs, run_campaign
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.study import Study
from safevar_sumo.sumo import matrix, verification
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.verification import Sample, spread_points, verify_sample
from safevar_sumo.terminal import show_no_progress
from tests.in_process import InlinePool
from tests.made_up import drawn

TESTS = ("cut_in", "cut_out", "following")
Repeated = list[tuple[str, FloatArray, SimulationRuns]]


@pytest.fixture
def study() -> Study:
    return load_study("alks", search={"algorithms": ["rs"], "runs": 1, "evaluations": 8})


@pytest.fixture
def repeated(monkeypatch: pytest.MonkeyPatch) -> Repeated:
    """The scenarios, settings and runs that SUMO is to repeat."""
    them: Repeated = []

    def note(system: System, settings: FloatArray, runs: SimulationRuns) -> None:
        them.append((type(system.scenario).__name__, settings, runs))

    monkeypatch.setattr(verification, "_verify_point", note)
    return them


def with_fault(test: str) -> Callable[..., Any]:
    """The fast engine, in which vehicles of one test brake a little later than they do."""
    drive_all = matrix.drive_all

    def drive(system: System, *arguments: Any) -> SimulationRuns:
        runs = drive_all(system, *arguments)
        names = [dict(point.parameters)["test"] for point in system.points]
        is_of_test = np.repeat(np.array(names) == test, len(runs.outcome) // len(names))
        gap = runs.trace.gap + np.where(is_of_test, 1e-3, 0.0)
        return replace(runs, trace=replace(runs.trace, gap=gap))

    return drive


@pytest.mark.slow
@pytest.mark.parametrize("test", TESTS)
def test_a_fault_of_the_fast_engine_in_one_test_of_a_matrix_is_found(
    test: str, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matrix, "drive_all", with_fault(test))
    with pytest.raises(InputError, match=r"gap at .* in the recorded scene and .* in SUMO"):
        run_campaign(
            study,
            assemble(study),
            all_runs(study),
            tmp_path,
            InlinePool(),
            show_no_progress,
            lambda remark: None,
        )


def test_a_sample_has_each_unsafe_setting_once_and_safe_simulations_of_every_test(
    study: Study, repeated: Repeated
) -> None:
    """Half of a point's safe simulations are those with the least clearance there."""
    system = assemble(study)
    settings = drawn(system, 40, 2)
    points = spread_points(system)
    unsafe = settings[10:14]
    worst = np.array([0, 0, 3, 14])
    counts = list[int]()
    sample = Sample(unsafe, worst, settings[14:], 30, points)
    safe, remark = verify_sample(system, Unsafe(), sample, counts.append)
    assert 30 <= safe <= 32, "of each kind of outcome one, too"
    assert not remark
    tests = Counter[str]()
    for test, rows, _ in repeated:
        tests[test] += len(rows)
    assert {*tests} == {"CutIn", "CutOut", "CarToCar"}
    assert counts[-1] == sum(tests.values())
    assert counts == sorted(counts)
    collided = sum(int((runs.outcome == "collision").sum()) for *_, runs in repeated)
    assert collided <= len(unsafe), "safe simulations, and the unsafe settings at their worst point"
    for setting in unsafe:
        assert any((rows == setting).all(axis=1).any() for _, rows, _ in repeated)


def test_the_sample_of_one_scenario_has_those_with_the_least_clearance(repeated: Repeated) -> None:
    system = assemble(load_study("smoke"))
    settings = drawn(system, 200, 4)
    nothing = Sample(settings[:0], np.zeros(0, dtype=np.intp), settings, 60, [0])
    found = matrix.drive_and_score(system, settings)
    safe = np.flatnonzero(~found.collided)
    number, _ = verify_sample(system, Unsafe(), nothing, lambda repeated: None)
    assert 60 <= number <= 62, "one of each kind of outcome is among them"
    [(_, rows, _)] = repeated
    named = {row.tobytes() for row in rows}
    least = safe[np.argsort(found.f_safe[safe], kind="stable")[:30]]
    assert {row.tobytes() for row in settings[least]} <= named
    assert {row.tobytes() for row in settings[found.collided]}.isdisjoint(named)


def test_points_of_a_sample_are_of_every_test() -> None:
    """Ten tests of one point each, beside one of sixty."""
    parameters = {"test": "CCRs", "vut_length": 4.7, "vut_width": 1.85}
    many = {"name": "many", "parameters": parameters, "over": {"speed": [*range(20, 80)]}}
    few = [
        {"name": f"few {speed}", "parameters": {**parameters, "speed": speed}}
        for speed in range(30, 40)
    ]
    car = {"model": "car_to_car", "parameters": {}}
    system = assemble(load_study("wear", scenario=car, matrix={"tests": [many, *few]}))
    names = {dict(system.points[number].parameters)["test"] for number in spread_points(system)}
    assert names == {test["name"] for test in [many, *few]}
    assert len(spread_points(system)) <= 26


@pytest.mark.slow
def test_a_dry_run_counts_the_start_and_the_verification(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations that take no time leave both."""
    monkeypatch.setattr(command, "measure_speed", lambda *arguments: 1e9)
    alone = command.study("smoke", dry_run=True, jobs=1).numbers["seconds"]
    monkeypatch.setattr(command, "measure_verification", lambda *arguments: 1000.0)
    assert 0.5 < alone < 1000
    assert command.study("smoke", dry_run=True, jobs=1).numbers["seconds"] > 1000
    in_sumo = command.study("smoke", dry_run=True, jobs=1, engine="sumo").numbers
    assert in_sumo["seconds"] < 1000, "SUMO verifies nothing that it has simulated itself"


@pytest.mark.slow
def test_a_dry_run_counts_the_summary_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """In which the original vehicle drives once more: here it takes 100 s, and the start 2 s."""
    now = [0.0]

    def take_time(system: System) -> None:
        now[0] += 100

    clock = SimpleNamespace(monotonic=lambda: now[0], process_time=lambda: 2.0)
    monkeypatch.setattr(command, "time", clock)
    monkeypatch.setattr(command, "why_no_verdict", take_time)
    monkeypatch.setattr(command, "measure_speed", lambda *arguments: 1e9)
    monkeypatch.setattr(command, "measure_verification", lambda *arguments: 0.0)
    seconds = command.study("smoke", dry_run=True, jobs=1).numbers["seconds"]
    assert seconds == pytest.approx(102, abs=1e-3)
