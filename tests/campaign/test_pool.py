"""Workers in processes of this machine; what becomes of jobs whose workers die and of settings that
fail.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import evaluation
from safevar_sumo.campaign.evaluation import (
    Task,
    carry_out,
    evaluate_settings,
    reproduction_command,
)
from safevar_sumo.campaign.pool import Pool, WorkerLostError, open_pool
from safevar_sumo.errors import (
    EnvironmentFault,
    InputError,
    SafevarError,
    SimulationError,
    UserCodeError,
)
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.study import ModelTable, Origin, Study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.formulas import evaluated
from tests.support.in_process import SLOW
from tests.support.made_up import SUN
from tests.support.processes import workers_of

pytestmark = pytest.mark.usefixtures("worker_processes")


def processes() -> list[psutil.Process]:
    return workers_of(os.getpid())


@pytest.fixture
def pool() -> Iterator[Pool]:
    with open_pool(1) as pool:
        yield pool


def die(path: Path, times: int) -> str:
    """A job whose first workers die of it: each leaves a letter in a file."""
    with path.open("a") as file:
        file.write("x")
    if path.stat().st_size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


@SLOW
def test_workers_start_when_they_are_needed_and_end_with_the_block() -> None:
    with open_pool(2) as pool:
        assert not processes()
        assert pool.map(abs, [(-1,)]) == [1]
        assert len(processes()) == 1
        assert pool.map(abs, [(-k,) for k in range(9)]) == list(range(9))
        assert len(processes()) == 2
    assert not processes()


@SLOW
def test_the_job_of_a_dead_worker_is_carried_out_once_more_and_others_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with open_pool(2) as pool:
        jobs = [(tmp_path / str(k), int(k == 1)) for k in range(4)]
        assert pool.map(die, jobs) == ["done"] * 4
        assert [len(path.read_text()) for path, _ in jobs] == [1, 2, 1, 1]
        assert re.findall(r"was lost in job (\d)", caplog.text) == ["1"]
        with pytest.raises(
            WorkerLostError, match=r"the worker process died \(exit code -9\)"
        ) as lost:
            pool.map(die, [(tmp_path / "a", 0), (tmp_path / "b", 2)])
        assert lost.value.job == 1
        os.kill(processes()[0].pid, signal.SIGKILL)
        time.sleep(0.1)
        assert pool.map(abs, [(-1,)]) == [1], (
            "one that dies between two jobs is replaced"
        )


def take(task: Task, seconds: float) -> None:
    with evaluation.end_if_longer(task.study.search.time_limit):
        time.sleep(seconds)


@SLOW
def test_work_of_which_two_workers_die_is_named_with_its_study(pool: Pool) -> None:
    """And with its user code, as a test of studies in processes of their own says."""
    study = load_study("smoke", search={"time_limit": 0.2})
    why = "two workers were lost at the same work, 9: a batch took longer than the time limit"
    with pytest.raises(SafevarError, match=f"study 'smoke': {why}"):
        carry_out(take, [(Task(study=study), 9)], pool)
    assert not processes(), "it would keep a core busy beside its successor"


def test_an_error_of_the_study_arrives_as_it_is(pool: Pool) -> None:
    study = load_study("smoke")
    wrong = replace(study, ads=ModelTable(model="world_on_roads"), spread={})
    with pytest.raises(InputError, match="world_on_roads") as caught:
        carry_out(evaluate_settings, [(Task(study=wrong), SUN.original_settings)], pool)
    assert "expected" in str(caught.value)
    assert carry_out(
        evaluate_settings, [(Task(study=study), SUN.original_settings)], pool
    )[0].valid.all()


STUDY = load_study("sun")
WITH_USER_CODE = replace(
    STUDY,
    ads=ModelTable(model="my_ads:Mine"),
    spread={},
    origin=Origin(called="my study.toml"),
)


def settings(number: int) -> FloatArray:
    """Settings whose first value tells which it is."""
    rows = np.repeat(SUN.original_settings, number, axis=0)
    rows[:, 0] = 4300 + np.arange(number)
    return rows


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[int]]:
    """Let batches with settings of these first values fail; returns the sizes of all batches that
    are tried.
    """

    def let_fail(error: Exception, *values: float) -> list[int]:
        sizes = list[int]()

        def evaluate(task: Task, rows: FloatArray) -> Evaluations:
            sizes.append(len(rows))
            if np.isin(rows[:, 0], values).any():
                raise error
            return evaluated(rows)

        monkeypatch.setattr(evaluation, "evaluate_batch", evaluate)
        return sizes

    return let_fail


def test_a_setting_that_sumo_refuses_is_told_from_the_others(
    fail: Callable[..., list[int]],
) -> None:
    fail(SimulationError("SUMO failed:\n no place"), 4302, 4305)
    result = evaluate_settings(Task(study=STUDY), settings(8))
    assert np.array_equal(result.settings, settings(8))
    assert np.array_equal(result.valid, ~np.isin(settings(8)[:, 0], (4302, 4305)))
    assert result.outcome[2] == Outcome.SIMULATOR_ERROR
    assert result.reason(2) == "SUMO failed: no place"
    assert np.isnan(result.f_safe[2])
    assert np.array_equal(
        result.f_safe[result.valid], evaluated(settings(8)).f_safe[result.valid]
    )
    assert np.array_equal(result.f_num_diff, SUN.number_changed(settings(8)))


def test_what_a_users_code_does_on_one_setting_is_an_error_that_names_it(
    fail: Callable[..., list[int]],
) -> None:
    sizes = fail(
        UserCodeError(
            "study", "ads.model = 'my_ads:Mine' raised in drive: ZeroDivisionError"
        ),
        4313,
    )
    with pytest.raises(UserCodeError) as caught:
        evaluate_settings(Task(study=WITH_USER_CODE), settings(50))
    assert (
        "ZeroDivisionError; to reproduce it: python -m safevar_sumo simulate 'my study.toml' --set "
        in str(caught.value)
    )
    assert f"--set {SUN.names[0]}=4313.0" in str(caught.value)
    assert str(caught.value).count("--set") == 1, "what is not changed need not be set"
    assert len(sizes) <= 1 + 2 * 6, "halvings of 50"


def test_a_full_disk_or_memory_is_no_property_of_a_setting(
    fail: Callable[..., list[int]],
) -> None:
    fail(MemoryError(), 4300)
    with pytest.raises(
        EnvironmentFault, match="a batch cannot be computed: no memory is left"
    ):
        evaluate_settings(Task(study=STUDY), settings(2))


def reproduced(study: Study, **values: float) -> str:
    """What follows the study's name in the command that reproduces these values."""
    setting = CharacteristicSet.of(study).setting(values, beyond=True)
    return reproduction_command(study, setting).partition(f"simulate {study.name}")[2]


def test_the_command_that_reproduces_a_setting_keeps_small_changes_and_the_point() -> (
    None
):
    study = load_study("euro_ncap_car_to_car")
    original = SUN.original[SUN.names.index("mass")]
    assert reproduced(study, mass=original + 200) == f" --set mass={original + 200}"
    assert reproduced(study, mass=original + 5) == f" --set mass={original + 5}"
    assert (
        reproduced(study, mass=original * 9) == f" --set mass={original * 9} --beyond"
    )
    point = assemble(study).matrix[3].name
    assert (
        reproduced(at_point(study, point), mass=original + 200)
        == f" --point '{point}' --set mass={original + 200}"
    )
