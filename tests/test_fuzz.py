"""Whatever is in a study file, a flag, a CSV file or an ADS: an answer or an error of one kind, never a traceback, and
soon.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings, strategies as st

import safevar_sumo.cli.study
from safevar_sumo.ads import Ads, GuardedAds, PerVehicleAds
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError, SafevarError, UserCodeError
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Nominal, Observation, PedalTables
from safevar_sumo.study import Study, load_study, tables_of
from safevar_sumo.study.file import drop_nulls
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.campaign.formulas import FormulaPool

TABLES = drop_nulls(tables_of(load_study("smoke")))
SCALARS = st.one_of(
    st.integers(), st.floats(), st.text(max_size=20), st.booleans(), st.dates(), st.datetimes(), st.times()
)
ANYTHING = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
    max_leaves=6,
)
SLOW = settings(
    max_examples=25,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
)


def paths(tables: dict[str, Any], before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every key of nested tables."""
    inner = [path for key, value in tables.items() if isinstance(value, dict) for path in paths(value, (*before, key))]
    return [*((*before, key) for key in tables), *inner]


def replaced(tables: dict[str, Any], path: tuple[str, ...], value: object) -> dict[str, Any]:
    key, *rest = path
    return {**tables, key: value if not rest else replaced(tables[key], tuple(rest), value)}


@SLOW
@given(path=st.sampled_from(paths(TABLES)), value=ANYTHING)
def test_a_study_with_anything_in_one_place_is_read_or_refused(path: tuple[str, ...], value: object) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "mine.toml"
        try:
            file.write_text(tomli_w.dumps(replaced(TABLES, path, value)), encoding="utf-8")
        except (ValueError, UnicodeError):
            return
        try:
            study = load_study(str(file))
            assemble(study, str(file))
        except InputError:
            return
        assert isinstance(study, Study)
        numbers = list(study.vehicle.characteristics.values())
        assert all(math.isfinite(row.original) and row.lower < row.upper for row in numbers)


NOTHING = np.zeros(2)
SEEN = Observation(0.0, NOTHING, NOTHING, NOTHING, NOTHING, NOTHING, 1.0)
KNOWN = Nominal(1.0, 1.0, 1.0, 1.0, 1.0, lambda: PedalTables(NOTHING, NOTHING, NOTHING, 1.0))
COMMANDS = st.one_of(
    ANYTHING,
    st.none(),
    st.tuples(ANYTHING, ANYTHING),
    st.tuples(st.floats(), st.floats()),
    st.tuples(st.floats(0, 1), st.sampled_from([0, True, np.float32(0.5), np.array(0.5), np.array([0.5])])),
)


class Returning(Ads):
    """An ADS, for one vehicle or for many, that returns what it is given."""

    def __init__(self, what: object) -> None:
        self._what = what

    def start(self, *_: object) -> None:
        return None

    def drive(self, *_: object) -> Any:
        return self._what


@settings(max_examples=100)
@given(what=COMMANDS)
def test_whatever_an_ads_commands_is_two_pedals_for_each_vehicle_or_an_error(what: object) -> None:
    guard = Guard("mine.toml", "ads.model = 'mine:Mine'")
    batched: Any = Returning((what, None))
    single: Any = lambda: Returning(what)  # noqa: E731
    for ads in (GuardedAds(batched, guard), PerVehicleAds(single, guard)):
        try:
            command, _ = ads.drive(SEEN, ads.start(2, KNOWN, 0.05))
        except UserCodeError:
            continue
        for pedal in command:
            assert pedal.shape == (2,)
            assert ((pedal >= 0) & (pedal <= 1)).all()


SMOKE = CharacteristicSet.of(load_study("smoke"))
FEW = settings(
    max_examples=12, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture], deadline=None
)
NUMBERS = st.one_of(
    st.integers(1, 20).map(str),
    st.text(max_size=5),
    st.sampled_from(
        [
            "0",
            "3",
            "2",
            "-1",
            "nan",
            "1e3",
            "\N{ARABIC-INDIC DIGIT THREE}",
            "1_0",
            "",
            " 2",
            "99999999999999999999",
            "0x1",
        ]
    ),
)
RUNS = st.one_of(
    st.text(max_size=6),
    st.sampled_from(
        [
            "nsga2:0",
            "rs:0",
            "rs:1",
            "nsga2:-1",
            ":",
            "nsga2:\N{ARABIC-INDIC DIGIT ZERO}",
            "1/1",
            "1/2",
            "2/2",
            "0/1",
            "3/2",
            "1/0",
            "/",
        ]
    ),
)
NAMES = st.lists(
    st.one_of(st.sampled_from(["nsga2", "rs", "safe_fuzzer", " rs", "", "os:system"]), st.text(max_size=5)), max_size=3
).map(",".join)
STUDY = st.lists(
    st.one_of(
        st.tuples(st.sampled_from(["--runs", "--evaluations", "--seed", "--batch", "--jobs"]), NUMBERS),
        st.tuples(st.sampled_from(["--only", "--shard"]), RUNS),
        st.tuples(st.just("--algorithms"), NAMES),
        st.sampled_from([("--quiet",), ("--dry-run",), ("--retry-failed",), ("--nothing",), ("--cluster", "nowhere")]),
    ),
    max_size=3,
)


@contextmanager
def no_pool(*_: object) -> Iterator[FormulaPool]:
    yield FormulaPool()


def tried(*arguments: str) -> None:
    """Exit code 0 or a told failure: 1 for what failed, 2 for bad input."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(commands, arguments)
    error = done.exception
    assert (
        error is None or isinstance(error, SafevarError) or (isinstance(error, SystemExit) and error.code in (0, 2))
    ), (arguments, error)
    if isinstance(error, SafevarError):
        assert error.exit_code in (1, 2), arguments
        assert len(str(error).splitlines()) <= 2, arguments


def test_study_takes_or_refuses_its_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safevar_sumo.cli.study, "open_pool", no_pool)
    FEW(given(STUDY)(searched))()


def searched(flags: list[tuple[str, ...]]) -> None:
    tried("study", "smoke", "--runs", "1", "--evaluations", "10", *(part for flag in flags for part in flag))
