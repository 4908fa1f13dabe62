"""Worker processes of this machine."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import suppress

import numpy as np
import psutil
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import PoolLostError, WorkerLostError, packed
from safevar_sumo.workers.local import LocalPool, first_of, interrupts_noted, local_pool, result_of

pytestmark = pytest.mark.usefixtures("worker_processes")
SMOKE = packed(load_study("smoke"))
ORIGINAL = CharacteristicSet.of(load_study("smoke").vehicle.characteristics).original[np.newaxis]


def processes() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]


@pytest.fixture
def pool() -> Iterator[LocalPool]:
    with local_pool(1, 30.0) as pool:
        yield pool


def test_workers_start_when_they_are_needed_and_end_with_the_block() -> None:
    with local_pool(2, 30.0) as pool:
        assert not processes()
        for future in [pool.submit(SMOKE, ORIGINAL) for _ in range(4)]:
            future.result(timeout=30)
        assert len(processes()) == 2
    assert not processes()
    with pytest.raises(PoolLostError):
        pool.submit(SMOKE, ORIGINAL)


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
    future = pool.submit(SMOKE, np.repeat(ORIGINAL, 2000, axis=0))
    time.sleep(0.1)
    os.kill(processes()[0].pid, signal.SIGKILL)
    with pytest.raises(WorkerLostError, match="exit code -9"):
        future.result(timeout=30)
    assert pool.submit(SMOKE, ORIGINAL).result(timeout=30).valid.all()


def test_a_worker_that_was_killed_while_it_started_costs_nothing(pool: LocalPool) -> None:
    future = pool.submit(SMOKE, ORIGINAL)
    for _ in range(2):
        while not (young := processes()):
            time.sleep(0.005)
        os.kill(young[0].pid, signal.SIGKILL)
        with suppress(psutil.NoSuchProcess):
            while young[0].status() != psutil.STATUS_ZOMBIE:
                time.sleep(0.005)
        time.sleep(0.05)
    assert future.result(timeout=30).valid.all()


def test_what_takes_too_long_is_stopped() -> None:
    with local_pool(1, 0.2) as pool:
        with pytest.raises(WorkerLostError, match=r"longer than 0\.2 s"):
            pool.submit(SMOKE, np.repeat(ORIGINAL, 2000, axis=0)).result(timeout=30)
        assert not processes(), "it would keep a core busy beside its successor"


def test_an_error_of_the_study_arrives_as_it_is_and_a_bug_with_its_traceback(pool: LocalPool) -> None:
    wrong = SMOKE.replace(b"world_on_rails", b"world_on_roads")
    with pytest.raises(InputError, match="world_on_roads") as told:
        pool.submit(wrong, ORIGINAL).result(timeout=30)
    assert "legal" in str(told.value)
    with pytest.raises(RuntimeError, match=r"(?s)Traceback.*evaluate_batch"):
        pool.submit(SMOKE, ORIGINAL[:, :3]).result(timeout=30)
    assert pool.submit(SMOKE, ORIGINAL).result(timeout=30).valid.all()


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_is_raised_where_a_result_is_waited_for_and_nowhere_else() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interrupts_noted():  # noqa: PT012
        press()
        press()
        with pytest.raises(KeyboardInterrupt):
            result_of(Future())
        press()  # while the pool is closed, say
    assert signal.getsignal(signal.SIGINT) is before
    with interrupts_noted():
        assert first_of([]) == set(), "what was pressed before is forgotten"


def test_ctrl_c_during_a_wait_is_noticed_soon() -> None:
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), interrupts_noted():
        first_of([Future()])
    assert time.monotonic() - start < 5
