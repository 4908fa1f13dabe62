"""Worker processes of this machine."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace

import msgspec
import numpy as np
import psutil
import pytest

from safevar_sumo.campaign.checks import find_difference, refuse_unlike_sumo
from safevar_sumo.campaign.evaluation import pack_study
from safevar_sumo.campaign.interrupts import defer_interrupts, wait_for_first, wait_for_result
from safevar_sumo.campaign.local import LocalPool, local_pool
from safevar_sumo.campaign.pool import PoolLostError, WorkerLostError
from safevar_sumo.campaign.retrying import RetryingPool, reproduction_command
from safevar_sumo.errors import EnvironmentFault, InputError, SimulationError, UserCodeError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.study import ModelTable, Origin, Study, load_study
from safevar_sumo.sumo.matrix import study_at
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

pytestmark = pytest.mark.usefixtures("worker_processes")
SMOKE = pack_study(load_study("smoke"))
ORIGINAL = CharacteristicSet.of(load_study("smoke").vehicle.characteristics).original[np.newaxis]


def processes() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]


@pytest.fixture
def pool() -> Iterator[LocalPool]:
    with local_pool(1, 30.0) as pool:
        yield pool


@pytest.mark.slow
def test_workers_start_when_they_are_needed_and_end_with_the_block() -> None:
    with local_pool(2, 30.0) as pool:
        assert not processes()
        for future in [pool.submit(SMOKE, ORIGINAL) for _ in range(4)]:
            future.result(timeout=30)
        assert len(processes()) == 2
    assert not processes()
    with pytest.raises(PoolLostError):
        pool.submit(SMOKE, ORIGINAL)


@pytest.mark.slow
def test_the_end_does_not_wait_for_what_is_computed() -> None:
    with local_pool(1, 600.0) as pool:
        pool.submit(SMOKE, ORIGINAL).result(timeout=30)
        futures = [pool.submit(SMOKE, np.repeat(ORIGINAL, 2000, axis=0)) for _ in range(3)]
        time.sleep(0.3)
        start = time.monotonic()
    assert time.monotonic() - start < 2
    assert all(future.done() for future in futures)


def test_a_killed_worker_is_told_and_replaced(pool: LocalPool) -> None:
    pool.submit(SMOKE, ORIGINAL).result(timeout=30)
    future = pool.submit(SMOKE, np.repeat(ORIGINAL, 100_000, axis=0))
    time.sleep(0.1)
    os.kill(processes()[0].pid, signal.SIGKILL)
    with pytest.raises(WorkerLostError, match="exit code -9"):
        future.result(timeout=30)
    assert pool.submit(SMOKE, ORIGINAL).result(timeout=30).valid.all()


def test_what_takes_too_long_is_stopped() -> None:
    with local_pool(1, 0.2) as pool:
        with pytest.raises(WorkerLostError, match=r"longer than 0\.2 s"):
            pool.submit(SMOKE, np.repeat(ORIGINAL, 100_000, axis=0)).result(timeout=30)
        assert not processes(), "it would keep a core busy beside its successor"


def test_an_error_of_the_study_arrives_as_it_is_and_a_bug_with_its_traceback(pool: LocalPool) -> None:
    wrong = SMOKE.replace(b"world_on_rails", b"world_on_roads")
    with pytest.raises(InputError, match="world_on_roads") as caught:
        pool.submit(wrong, ORIGINAL).result(timeout=30)
    assert "expected" in str(caught.value)
    with pytest.raises(RuntimeError, match=r"(?s)Traceback.*evaluate_batch"):
        pool.submit(SMOKE, ORIGINAL[:, :3]).result(timeout=30)
    assert pool.submit(SMOKE, ORIGINAL).result(timeout=30).valid.all()


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_is_raised_where_a_result_is_waited_for_and_nowhere_else() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), defer_interrupts():  # noqa: PT012
        press()
        press()
        with pytest.raises(KeyboardInterrupt):
            wait_for_result(Future())
        press()  # while the pool is closed, say
    assert signal.getsignal(signal.SIGINT) is before
    with defer_interrupts():
        assert wait_for_first([]) == set(), "what was pressed before is forgotten"


def test_ctrl_c_during_a_wait_is_noticed_soon() -> None:
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), defer_interrupts():
        wait_for_first([Future()])
    assert time.monotonic() - start < 5


STUDY = load_study("sun")
SUN = CharacteristicSet.of(STUDY.vehicle.characteristics)
WITH_USER_CODE = msgspec.structs.replace(
    STUDY, ads=ModelTable(model="my_ads:Mine"), origin=Origin(called="my study.toml")
)


def settings(number: int) -> np.ndarray:
    """Settings whose first value tells which it is."""
    rows = np.repeat(SUN.original[np.newaxis], number, axis=0)
    rows[:, 0] = 4300 + np.arange(number)
    return rows


def evaluated(rows: np.ndarray) -> Evaluations:
    return Evaluations(
        settings=rows,
        outcome=np.full(len(rows), "stopped", dtype="U16"),
        collision_speed=np.full(len(rows), np.nan),
        metrics={name: rows[:, 0] / 3 for name in METRICS},
        f_diff=SUN.largest_change(rows),
        f_num_diff=SUN.number_changed(rows),
    )


class ToldPool:
    """Fails with what `fault` answers to (settings, how often they were tried before)."""

    workers = 1

    def __init__(self, fault: Callable[[np.ndarray, int], Exception | None]) -> None:
        self.fault = fault
        self.tried: list[int] = []
        self._times: dict[bytes, int] = {}

    def submit(self, study: bytes, settings: np.ndarray) -> Future[Evaluations]:
        before = self._times.get(settings.tobytes(), 0)
        self._times[settings.tobytes()] = before + 1
        self.tried.append(len(settings))
        error = self.fault(settings, before)
        future: Future[Evaluations] = Future()
        if error is None:
            future.set_result(evaluated(settings))
        else:
            future.set_exception(error)
        return future


def test_metrics_that_only_one_side_has_are_a_difference() -> None:
    one = evaluated(settings(1))
    assert find_difference(one, one) is None
    fewer = replace(one, metrics={name: values for name, values in one.metrics.items() if name != "safety_degree"})
    for both in ((one, fewer), (fewer, one)):
        name, *lists = find_difference(*both) or ("no difference",)
        assert name == "the list of metrics"
        assert sum("safety_degree" in str(names) for names in lists) == 1


def test_settings_that_all_fail_in_sumo_lack_the_users_metrics() -> None:
    once = evaluated(settings(1))
    recorded = replace(once, metrics={**once.metrics, "mine": np.array([1.0])})
    failed = replace(once, outcome=np.array([Outcome.SIMULATOR_ERROR.value], dtype="U16"))
    refuse_unlike_sumo(STUDY, recorded, failed)
    with pytest.raises(InputError, match=r"mine is 1\.0 in the recorded scene and 2\.0 in SUMO"):
        refuse_unlike_sumo(STUDY, recorded, replace(recorded, metrics={**once.metrics, "mine": np.array([2.0])}))


def died() -> WorkerLostError:
    return WorkerLostError("the worker process died (exit code -9)")


def deadly(*values: float) -> Callable[[np.ndarray, int], Exception | None]:
    return lambda rows, before: died() if np.isin(rows[:, 0], values).any() else None


def test_a_batch_that_lost_its_worker_once_is_tried_again() -> None:
    pool = ToldPool(lambda rows, before: None if before else died())
    result = RetryingPool(pool, STUDY).submit(b"", settings(8)).result(timeout=5)
    assert pool.tried == [8, 8]
    assert result.valid.all()


def test_the_setting_that_kills_its_worker_alone_is_told_from_the_others() -> None:
    pool = ToldPool(deadly(4302, 4305))
    result = RetryingPool(pool, STUDY).submit(b"", settings(8)).result(timeout=5)
    assert np.array_equal(result.settings, settings(8))
    assert np.array_equal(result.valid, ~np.isin(settings(8)[:, 0], (4302, 4305)))
    assert result.outcome[2] == Outcome.SIMULATOR_ERROR
    assert np.isnan(result.objectives[2, 0])
    assert np.array_equal(result.f_safe[result.valid], settings(8)[result.valid, 0] / 3)
    assert np.array_equal(result.f_num_diff, SUN.number_changed(settings(8)))
    assert pool.tried == [8, 8] + [1] * (6 + 2 * 3), "each alone, the original, and once more"


def test_what_the_study_is_at_fault_for_ends_at_once_with_that_fault() -> None:
    pool = ToldPool(lambda rows, before: InputError("study", "ads.model = 'x' cannot be imported"))
    with pytest.raises(InputError, match="cannot be imported"):
        RetryingPool(pool, STUDY).submit(b"", settings(1000)).result(timeout=5)
    assert len(pool.tried) == 1


@pytest.mark.parametrize("fault", [SimulationError("SUMO failed: no place"), WorkerLostError("died")])
def test_a_setting_is_blamed_only_if_the_original_vehicle_can_be_simulated(fault: Exception) -> None:
    with pytest.raises(EnvironmentFault, match=f"{fault}; the original vehicle cannot be simulated either"):
        RetryingPool(ToldPool(lambda rows, before: fault), STUDY).submit(b"", settings(4)).result(timeout=5)


def test_a_fault_of_the_surroundings_is_an_error_and_no_outcome() -> None:
    pool = ToldPool(
        lambda rows, before: EnvironmentFault("the disk is full") if np.isin(rows[:, 0], 4302).any() else None
    )
    with pytest.raises(EnvironmentFault, match="the disk is full"):
        RetryingPool(pool, STUDY).submit(b"", settings(4)).result(timeout=5)
    assert pool.tried == [4, 4]


def test_what_a_users_code_does_on_one_setting_is_an_error_that_names_it() -> None:
    def fault(rows: np.ndarray, before: int) -> Exception | None:
        return (
            UserCodeError("study", "ads.model = 'my_ads:Mine' raised in drive: ZeroDivisionError")
            if 4313 in rows[:, 0]
            else None
        )

    pool = ToldPool(fault)
    with pytest.raises(UserCodeError) as caught:
        RetryingPool(pool, WITH_USER_CODE).submit(b"", settings(50)).result(timeout=5)
    assert "ZeroDivisionError; to reproduce it: python -m safevar_sumo simulate 'my study.toml' --set " in str(
        caught.value
    )
    assert f"--set {SUN.names[0]}=4313.0" in str(caught.value)
    assert str(caught.value).count("--set") == 1, "what is not changed need not be set"
    assert len(pool.tried) < 15


def reproduced(study: Study, **values: float) -> str:
    """What follows the study's name in the command that reproduces these values."""
    setting = CharacteristicSet.of(study.vehicle.characteristics).setting(values, "test", beyond=True)
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
    rated = load_study("euro_ncap_rating")
    cell = assemble(rated).matrix[3].name
    assert f"--point '{cell}'" in reproduced(study_at(rated, cell, "test"))


def test_settings_that_fail_one_after_the_other_without_end_are_a_fault_of_the_study() -> None:
    pool = RetryingPool(ToldPool(deadly(*4300 + np.arange(40))), STUDY)
    assert not pool.submit(b"", settings(19)).result(timeout=5).valid.any()
    with pytest.raises(WorkerLostError, match="exit code -9"):
        pool.submit(b"", settings(2)).result(timeout=5)


def test_failures_between_successes_are_no_fault_of_the_study() -> None:
    every_second = 4300 + np.arange(0, 200, 2)
    result = RetryingPool(ToldPool(deadly(*every_second)), STUDY).submit(b"", settings(200)).result(timeout=5)
    assert np.count_nonzero(~result.valid) == 100


def test_the_original_vehicle_must_succeed() -> None:
    with pytest.raises(WorkerLostError):
        RetryingPool(ToldPool(deadly(4300)), STUDY).submit(b"", settings(1), must_succeed=True).result(timeout=5)


@pytest.mark.parametrize("error", [ZeroDivisionError("a bug"), PoolLostError("gone")])
def test_a_bug_and_a_lost_pool_are_not_tried_again(error: Exception) -> None:
    pool = ToldPool(lambda rows, before: error)
    with pytest.raises(type(error), match=str(error)):
        RetryingPool(pool, STUDY).submit(b"", settings(5)).result(timeout=5)
    assert pool.tried == [5]
