"""What SUMO repeats of a search, and that it finds a fault of the fast engine in any test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import RunKey
from safevar_sumo.campaign.campaign import UNSAFE_REPEATED, choose_sample
from safevar_sumo.campaign.runs import MAX_REPEATED, RunResult
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, SimulationRuns
from safevar_sumo.study import Study
from safevar_sumo.sumo import matrix, verification
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.verification import verify_in_sumo
from tests.support.formulas import with_search
from tests.support.in_process import SLOW, searched
from tests.support.made_up import drawn, made_up_evaluations

TESTS = ("CutIn", "CutOut", "CarToCar")
"""Scenarios of the tests of `alks`."""


@pytest.fixture
def study() -> Study:
    return load_study(
        "alks", search={"algorithms": ["rs"], "runs": 1, "evaluations": 8}
    )


def with_fault(test: str) -> Callable[..., Any]:
    """The fast engine, in which vehicles of one test brake a little later than they do."""
    drive_all = matrix.drive_all

    def drive(system: System, *arguments: Any) -> SimulationRuns:
        runs = drive_all(system, *arguments)
        names = [type(point.scenario).__name__ for point in system.points]
        is_of_test = np.repeat(np.array(names) == test, len(runs.outcome) // len(names))
        gap = runs.trace.gap + np.where(is_of_test, 1e-3, 0.0)
        return replace(runs, trace=replace(runs.trace, gap=gap))

    return drive


@SLOW
@pytest.mark.parametrize("test", TESTS)
def test_a_fault_of_the_fast_engine_in_one_test_of_a_matrix_is_found(
    test: str, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time that the command is given; the results are kept."""
    faulty = with_fault(test)
    for module in (matrix, verification):
        monkeypatch.setattr(module, "drive_all", faulty)
    for _ in range(2):
        with pytest.raises(
            InputError, match=r"gap at .* in the recorded scene and .* in SUMO"
        ):
            searched(study, tmp_path)
        assert (tmp_path / "solutions.csv").exists()


def test_each_setting_drives_at_its_worst_point_and_one_of_each_test_has_its_turn(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    repeated = []

    def note(system: System, settings: FloatArray, runs: SimulationRuns) -> None:
        repeated.append((system.points[0], settings))

    monkeypatch.setattr(verification, "_verify_point", note)
    system = assemble(study)
    settings = drawn(system, 12, 2)
    worst = np.repeat([0, 3], 6)
    assert not verify_in_sumo(system, settings, worst)
    assert {type(point.scenario).__name__ for point, _ in repeated} == {*TESTS}
    for number in (0, 3):
        scenario = system.points[number].scenario
        (rows,) = [rows for point, rows in repeated if point.scenario is scenario]
        at_point = {row.tobytes() for row in rows}
        assert {row.tobytes() for row in settings[worst == number]} <= at_point
    assert sum(len(rows) for _, rows in repeated) == 2 * len(settings)


def test_a_sample_has_unsafe_solutions_once_and_others_that_the_seed_draws(
    study: Study,
) -> None:
    """Of two runs whose settings are partly the same."""
    rng = np.random.default_rng(1)
    settings = rng.random((5000, len(study.domains)))
    requested = made_up_evaluations(rng.uniform(-1, 1, 5000), settings=settings)
    requested = replace(requested, worst_points=np.arange(5000) % 15)
    solutions = requested.take(np.arange(400))
    samples = requested.take(np.arange(100, 400)), requested.take(np.arange(300, 600))
    runs = [RunResult(RunKey("rs", run), solutions, samples[run]) for run in (0, 1)]
    original = made_up_evaluations([1.0], settings=settings[:1])

    def chosen() -> Evaluations:
        return choose_sample(study, original, runs)

    sample = chosen()
    collided = {row.tobytes() for row in solutions.settings[solutions.collided]}
    keys = [row.tobytes() for row in sample.settings]
    assert len(keys) == len({*keys}) == MAX_REPEATED
    assert {*keys[:UNSAFE_REPEATED]} <= collided
    known = {
        row.tobytes(): point
        for row, point in zip(settings, requested.points, strict=True)
    }
    assert [known[key] for key in keys] == sample.points.tolist()
    assert np.array_equal(sample.settings, chosen().settings)
    assert not np.array_equal(
        sample.settings,
        choose_sample(with_search(study, seed=7), original, runs).settings,
    )


def test_a_search_without_a_solution_is_verified_too(study: Study) -> None:
    drawn_settings = np.arange(3.0 * len(study.domains)).reshape(3, -1)
    sample = made_up_evaluations([1.0, 1.0, 1.0], settings=drawn_settings)
    runs = [RunResult(RunKey("rs", 0), sample.take([]), sample)]
    assert len(choose_sample(study, sample.take([0]), runs)) == 3
