"""Flags of the commands that simulate, of any kind and in any order: an answer or an error of one kind, never a traceback."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import safevar_sumo.cli.study
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet

SMOKE = CharacteristicSet.of(load_study("smoke").vehicle.characteristics)
FEW = settings(max_examples=12, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture], deadline=None)
MANY = settings(FEW, max_examples=300)
NUMBERS = st.one_of(st.integers(1, 20).map(str), st.text(max_size=5), st.sampled_from(
    ["0", "3", "2", "-1", "nan", "1e3", "\N{ARABIC-INDIC DIGIT THREE}", "1_0", "", " 2", "99999999999999999999", "0x1"]))
RUNS = st.one_of(st.text(max_size=6), st.sampled_from(
    ["nsga2:0", "rs:0", "rs:1", "nsga2:-1", ":", "nsga2:\N{ARABIC-INDIC DIGIT ZERO}", "1/1", "1/2", "2/2", "0/1", "3/2", "1/0", "/"]))
NAMES = st.lists(st.one_of(st.sampled_from(["nsga2", "rs", "safe_fuzzer", " rs", "", "os:system"]), st.text(max_size=5)),
                 max_size=3).map(",".join)
STUDY = st.lists(st.one_of(
    st.tuples(st.sampled_from(["--runs", "--evaluations", "--seed", "--batch", "--jobs"]), NUMBERS),
    st.tuples(st.sampled_from(["--only", "--shard"]), RUNS), st.tuples(st.just("--algorithms"), NAMES),
    st.sampled_from([("--quiet",), ("--dry-run",), ("--retry-failed",), ("--nothing",), ("--cluster", "nowhere")])), max_size=3)
VALUES = st.one_of(st.floats().map(str), st.floats(-9, 9).map("{:+g}%".format), st.floats(-9, 9).map("{:+g}%".format), st.sampled_from(
    ["+10%", "-200%", "1.0..1.5:3", "1..2:0", "1..2:-3", "2..1:2", "1e999", "5e-324", "nan", "inf", "1..2:1e9", "%", "..", ":", "1e300%"]),
    st.text(max_size=8))
CHANGES = st.tuples(st.sampled_from([*SMOKE.names, "mass ", "f_diff"]), st.sampled_from(["=", "=", " = ", "=="]), VALUES).map("".join)
SIMULATE = st.lists(st.one_of(
    st.tuples(st.just("--set"), CHANGES), st.tuples(st.just("--set"), CHANGES),
    st.sampled_from([("--json",), ("--no-filter",), ("--beyond",), ("--trace", "t.csv")]),
    st.sampled_from([("--fewest",), ("--nothing",), ("--trace", "."), ("--plot", "p.txt"), ("--slower", "0"), ("--point", "x"),
                     ("--solution", "nsga2:0:0"), ("--json",)])), max_size=3)


class Formula:
    """A pool whose evaluations cost nothing."""

    workers = 1

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        safety = np.abs(settings / SMOKE.original - 1).max(axis=1)
        future.set_result(Evaluations(
            settings=settings, outcome=np.full(len(settings), "stopped", dtype="U16"), collision_speed=np.full(len(settings), np.nan),
            metrics=dict.fromkeys(METRICS, 1.0 - safety), f_diff=SMOKE.largest_change(settings), f_num_diff=SMOKE.number_changed(settings)))
        return future


@contextmanager
def no_pool(*_: object) -> Iterator[Formula]:
    yield Formula()


def tried(*arguments: str) -> None:
    """Exit code 0 or a told failure: 1 for what failed, 2 for bad input."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(commands, arguments)
    error = done.exception
    assert error is None or isinstance(error, SafevarError) or (isinstance(error, SystemExit) and error.code in (0, 2)), (arguments, error)
    if isinstance(error, SafevarError):
        assert error.exit_code in (1, 2), arguments
        assert len(str(error).splitlines()) <= 2, arguments


def test_study_takes_or_refuses_its_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safevar_sumo.cli.study, "open_pool", no_pool)
    FEW(given(STUDY)(searched))()


def searched(flags: list[tuple[str, ...]]) -> None:
    tried("study", "smoke", "--runs", "1", "--evaluations", "10", *(part for flag in flags for part in flag))


@pytest.mark.slow
def test_study_takes_or_refuses_many_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safevar_sumo.cli.study, "open_pool", no_pool)
    MANY(given(STUDY)(searched))()


def simulated(flags: list[tuple[str, ...]]) -> None:
    tried("simulate", "smoke", *(part for flag in flags for part in flag))


def test_simulate_takes_or_refuses_its_flags() -> None:
    FEW(given(SIMULATE)(simulated))()


@pytest.mark.slow
def test_simulate_takes_or_refuses_many_flags() -> None:
    MANY(given(SIMULATE)(simulated))()
