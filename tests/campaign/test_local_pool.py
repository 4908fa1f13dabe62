"""Worker processes of this machine, and of a cluster."""

from __future__ import annotations

import os
import pickle
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest

from safevar_sumo.campaign.cluster import ClusterPool
from safevar_sumo.campaign.evaluation import Task
from safevar_sumo.campaign.local import LocalPool, local_pool
from safevar_sumo.campaign.pool import (
    Batch,
    PoolLostError,
    WorkerLostError,
    defer_interrupts,
    evaluate_batches,
    wait_for_next,
)
from safevar_sumo.campaign.worker import reproduction_command
from safevar_sumo.errors import EnvironmentFault, InputError, SimulationError, UserCodeError
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.study import ModelTable, Origin, Study, load_study
from safevar_sumo.sumo.matrix import study_at
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.campaign.formulas import Death, FormulaPool, evaluated

pytestmark = pytest.mark.usefixtures("worker_processes")
SMOKE = Task(study=load_study("smoke")).packed
ORIGINAL = CharacteristicSet.of(load_study("smoke")).original[np.newaxis]


def processes() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]


@pytest.fixture
def pool() -> Iterator[LocalPool]:
    with local_pool(1, 30.0) as pool:
        yield pool


def evaluate(pool: LocalPool, settings: FloatArray = ORIGINAL, packed_task: bytes = SMOKE) -> Evaluations:
    return evaluate_batches([Batch(packed_task, settings)], pool)[0]


def carry(pool: LocalPool, settings: FloatArray) -> Future[None]:
    return pool.carry(Batch(SMOKE, settings), lambda message: None)


@pytest.mark.slow
def test_workers_start_when_they_are_needed_and_end_with_the_block() -> None:
    with local_pool(2, 30.0) as pool:
        assert not processes()
        evaluate_batches([Batch(SMOKE, ORIGINAL)] * 4, pool)
        assert len(processes()) == 2
    assert not processes()
    with pytest.raises(PoolLostError):
        evaluate(pool)


def test_a_killed_worker_is_told_and_replaced(pool: LocalPool) -> None:
    evaluate(pool)
    future = carry(pool, np.repeat(ORIGINAL, 100_000, axis=0))
    time.sleep(0.1)
    os.kill(processes()[0].pid, signal.SIGKILL)
    with pytest.raises(WorkerLostError, match="exit code -9"):
        future.result(timeout=30)
    assert evaluate(pool).valid.all()


def test_what_takes_too_long_is_stopped() -> None:
    with local_pool(1, 0.2) as pool:
        with pytest.raises(WorkerLostError, match=r"longer than 0\.2 s"):
            carry(pool, np.repeat(ORIGINAL, 100_000, axis=0)).result(timeout=30)
        assert not processes(), "it would keep a core busy beside its successor"


def test_an_error_of_the_study_arrives_as_it_is_and_a_bug_with_its_traceback(pool: LocalPool) -> None:
    wrong = SMOKE.replace(b"world_on_rails", b"world_on_roads")
    with pytest.raises(InputError, match="world_on_roads") as caught:
        evaluate(pool, packed_task=wrong)
    assert "expected" in str(caught.value)
    with pytest.raises(RuntimeError, match=r"(?s)Traceback.*evaluate_batch"):
        evaluate(pool, ORIGINAL[:, :3])
    assert evaluate(pool).valid.all()


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_is_raised_where_a_message_is_waited_for_and_nowhere_else() -> None:
    before, messages = signal.getsignal(signal.SIGINT), SimpleQueue[int]()
    with pytest.raises(KeyboardInterrupt), defer_interrupts():  # noqa: PT012
        press()
        press()
        with pytest.raises(KeyboardInterrupt):
            wait_for_next(messages)
        press()  # while the pool is closed, say
    assert signal.getsignal(signal.SIGINT) is before
    messages.put(1)
    with defer_interrupts():
        assert wait_for_next(messages) == 1, "what was pressed before is forgotten"


STUDY = load_study("sun")
SUN = CharacteristicSet.of(STUDY)
WITH_USER_CODE = msgspec.structs.replace(
    STUDY, ads=ModelTable(model="my_ads:Mine"), origin=Origin(called="my study.toml")
)


def settings(number: int) -> FloatArray:
    """Settings whose first value tells which it is."""
    rows = np.repeat(SUN.original[np.newaxis], number, axis=0)
    rows[:, 0] = 4300 + np.arange(number)
    return rows


class Told(FormulaPool):
    """Fails with what `fault` answers to (settings, how often they were tried before); a worker dies of some faults."""

    def __init__(self, fault: Callable[[FloatArray, int], Exception | None]) -> None:
        super().__init__()
        self.fault = fault
        self.tried: list[int] = []
        self._times = Counter[bytes]()

    def evaluate(self, packed_task: bytes, settings: FloatArray) -> Evaluations:
        self.tried.append(len(settings))
        error = self.fault(settings, self._times[settings.tobytes()])
        self._times[settings.tobytes()] += 1
        if error is not None:
            raise Death(str(error)) if isinstance(error, WorkerLostError) else error
        return evaluated(settings)


def tried(pool: Told, settings: FloatArray, study: Study = STUDY) -> Evaluations:
    return evaluate_batches([Batch(Task(study=study).packed, settings)], pool)[0]


def died() -> WorkerLostError:
    return WorkerLostError("the worker process died (exit code -9)")


def deadly(*values: float) -> Callable[[FloatArray, int], Exception | None]:
    return lambda rows, before: died() if np.isin(rows[:, 0], values).any() else None


def test_the_setting_that_kills_its_worker_alone_is_told_from_the_others() -> None:
    pool = Told(deadly(4302, 4305))
    result = tried(pool, settings(8))
    assert np.array_equal(result.settings, settings(8))
    assert np.array_equal(result.valid, ~np.isin(settings(8)[:, 0], (4302, 4305)))
    assert result.outcome[2] == Outcome.SIMULATOR_ERROR
    assert np.isnan(result.objectives[2, 0])
    assert np.array_equal(result.f_safe[result.valid], evaluated(settings(8)).f_safe[result.valid])
    assert np.array_equal(result.f_num_diff, SUN.number_changed(settings(8)))


@pytest.mark.parametrize("fault", [SimulationError("SUMO failed: no place"), WorkerLostError("died")])
def test_a_setting_is_blamed_only_if_the_original_vehicle_can_be_simulated(fault: Exception) -> None:
    with pytest.raises(EnvironmentFault, match=f"{fault}; the original vehicle cannot be simulated either"):
        tried(Told(lambda rows, before: fault), settings(4))


def test_twenty_failures_in_a_row_end_a_study_and_one_success_between_them_does_not() -> None:
    def fault(rows: FloatArray, before: int) -> Exception | None:
        return SimulationError("no place") if np.isin(rows[:, 0], 4301 + np.arange(20)).any() else None

    assert tried(Told(fault), settings(20)).failed.tolist() == [False] + [True] * 19
    with pytest.raises(SimulationError, match="no place"):
        tried(Told(fault), settings(21))


def test_what_a_users_code_does_on_one_setting_is_an_error_that_names_it() -> None:
    def fault(rows: FloatArray, before: int) -> Exception | None:
        return (
            UserCodeError("study", "ads.model = 'my_ads:Mine' raised in drive: ZeroDivisionError")
            if 4313 in rows[:, 0]
            else None
        )

    pool = Told(fault)
    with pytest.raises(UserCodeError) as caught:
        tried(pool, settings(50), WITH_USER_CODE)
    assert "ZeroDivisionError; to reproduce it: python -m safevar_sumo simulate 'my study.toml' --set " in str(
        caught.value
    )
    assert f"--set {SUN.names[0]}=4313.0" in str(caught.value)
    assert str(caught.value).count("--set") == 1, "what is not changed need not be set"
    assert len(pool.tried) == 1 + 6, "halvings of 50"


def reproduced(study: Study, **values: float) -> str:
    """What follows the study's name in the command that reproduces these values."""
    setting = CharacteristicSet.of(study).setting(values, "test", beyond=True)
    return reproduction_command(study, setting).partition(f"simulate {study.name}")[2]


def test_the_command_that_reproduces_a_setting_keeps_small_changes_and_the_point() -> None:
    study, original = load_study("euro_ncap_car_to_car"), SUN.original[SUN.names.index("mass")]
    assert reproduced(study, mass=original + 200) == f" --set mass={original + 200}"
    assert reproduced(study, mass=original + 5) == f" --set mass={original + 5} --no-filter"
    assert reproduced(study, mass=original * 9) == f" --set mass={original * 9} --beyond"
    point = assemble(study).matrix[3].name
    assert (
        reproduced(study_at(study, point, "test"), mass=original + 200)
        == f" --point '{point}' --set mass={original + 200}"
    )


def test_messages_of_a_task_that_has_ended_are_received(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = map(pickle.dumps, (b"late", None))
    monkeypatch.setattr("distributed.Queue", lambda *_, **__: SimpleNamespace(get=lambda timeout: next(waiting)))
    ended = SimpleNamespace(done=lambda: True, result=bool)
    client: Any = SimpleNamespace(submit=lambda *_, **__: ended)
    received: list[object] = []
    ClusterPool(client, 9.0).carry(Batch(SMOKE, ORIGINAL), received.append).result()
    assert received == [b"late"]
