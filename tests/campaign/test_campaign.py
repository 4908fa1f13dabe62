"""Runs carried by pools whose evaluations are formulas: in any shares, alone and together, with more or fewer
evaluations.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from safevar_sumo.campaign import RunKey, all_runs, forecast, run_campaign
from safevar_sumo.campaign.campaign import deal
from safevar_sumo.campaign.pool import PoolLostError, WorkerLostError
from safevar_sumo.campaign.run import Run
from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory, load_runs
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study, load_study, tables_of
from tests.campaign.formulas import SUN, Death, EventLog, FormulaPool, carried_out, solutions, with_search


@pytest.fixture
def study() -> Study:
    smoke = load_study("smoke")
    return msgspec.structs.replace(smoke, search=msgspec.structs.replace(smoke.search, algorithms=sorted(ALGORITHMS)))


@pytest.mark.slow
def test_results_depend_neither_on_workers_nor_on_order_nor_on_batches(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "a")
    for name, pool, batch in (
        ("b", FormulaPool(workers=7), None),
        ("c", FormulaPool(workers=3), 3),
        ("d", FormulaPool(workers=2), 1),
    ):
        carried_out(study, tmp_path / name, pool, batch=batch)
        assert solutions(tmp_path / name) == solutions(tmp_path / "a")
        pd.testing.assert_frame_equal(load_runs(tmp_path / name).evaluations, load_runs(tmp_path / "a").evaluations)


def test_runs_of_a_share_share_batches(study: Study, tmp_path: Path) -> None:
    large = with_search(study, population=40, evaluations=400, runs=10, algorithms=["rs"])
    together, alone = FormulaPool(workers=2), FormulaPool(workers=2)
    carried_out(large, tmp_path / "together", together)
    carried_out(large, tmp_path / "alone", alone, keys=[RunKey("rs", 3)])
    assert np.mean(together.sizes[1:]) > 3 * large.search.population
    assert alone.sizes[1:3] == [40, 40]
    one, other = (
        load_runs(tmp_path / name).evaluations.query("algorithm == 'rs' and run == 3") for name in ("together", "alone")
    )
    pd.testing.assert_frame_equal(one.reset_index(drop=True), other.reset_index(drop=True))


@pytest.mark.parametrize(
    ("workers", "runs_at_once", "sizes"),
    [(2, 160, {45}), (1, 80, {45}), (4, 160, {22, 23}), (16, 160, {5, 6}), (200, 160, {1}), (2, 8, {7, 8})],
)
def test_runs_are_dealt_in_equal_shares_with_equally_many_runs_of_each_algorithm(
    workers: int, runs_at_once: int, sizes: set[int]
) -> None:
    keys = [RunKey(name, run) for name in ("nsga2", "rs", "safe_fuzzer") for run in range(30)]
    shares = deal(keys, workers, runs_at_once)
    assert sorted(key for share in shares for key in share) == sorted(keys)
    assert {len(share) for share in shares} == sizes
    assert workers > 90 or len(shares) % workers == 0
    for share in shares:
        numbers = Counter(key.algorithm for key in share)
        assert len(share) < 3 or max(numbers.values()) - min(numbers.values()) <= 1


@pytest.mark.slow
def test_a_campaign_that_breaks_down_anywhere_is_resumed_where_it_was(study: Study, tmp_path: Path) -> None:
    whole = FormulaPool()
    carried_out(study, tmp_path / "whole", whole)
    for limit in (1, 2, 3, 7, 20, 41):
        out, first, second = tmp_path / str(limit), FormulaPool(limit=limit), FormulaPool()
        with pytest.raises(PoolLostError, match="broken down"):
            carried_out(study, out, first, batch=study.search.population)
        carried_out(study, out, second)
        assert solutions(out) == solutions(tmp_path / "whole")
        assert set(first.simulated + second.simulated) == set(whole.simulated)
        under_way = len(all_runs(study)) * study.search.population
        assert len(first.simulated) + len(second.simulated) <= len(whole.simulated) + under_way


def test_more_runs_extend_and_fewer_leave_out(study: Study, tmp_path: Path) -> None:
    pools = [FormulaPool() for _ in range(3)]
    carried_out(with_search(study, runs=3), tmp_path / "whole", pools[0])
    carried_out(with_search(study, runs=1), tmp_path / "grown", pools[1])
    carried_out(with_search(study, runs=3), tmp_path / "grown", pools[2])
    assert solutions(tmp_path / "grown") == solutions(tmp_path / "whole")
    assert len(pools[1].simulated) + len(pools[2].simulated) == len(pools[0].simulated), "each setting once"


def test_a_run_in_other_hands_is_left_to_them(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "whole")
    results = ResultsDirectory(tmp_path / "out", study)
    theirs = [results.journal("rs-01"), results.journal("original")]
    campaign = run_campaign(study, all_runs(study), results, FormulaPool(), EventLog())
    assert campaign.busy == [RunKey("rs", 1)]
    assert set(campaign.solutions) == set(all_runs(study)) - {RunKey("rs", 1)}
    for journal in theirs:
        journal.close()
    carried_out(study, tmp_path / "out")
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("budgets", [(55, 130), (100, 60)])
def test_more_or_fewer_evaluations_go_on_and_end_as_if_there_had_never_been_others(
    study: Study, tmp_path: Path, budgets: tuple[int, int]
) -> None:
    first, second = (with_search(study, evaluations=budget, runs=1) for budget in budgets)
    pools = [FormulaPool() for _ in range(3)]
    carried_out(first, tmp_path / "out", pools[0])
    carried_out(second, tmp_path / "out", pools[1])
    carried_out(second, tmp_path / "fresh", pools[2])
    assert solutions(tmp_path / "out") == solutions(tmp_path / "fresh")
    results, fresh = load_runs(tmp_path / "out"), load_runs(tmp_path / "fresh")
    pd.testing.assert_frame_equal(results.evaluations, fresh.evaluations)
    pd.testing.assert_frame_equal(results.solutions, fresh.solutions)
    assert len(set(pools[0].simulated)) + len(set(pools[1].simulated)) == len(
        set(pools[0].simulated) | set(pools[1].simulated)
    )
    carried_out(first, tmp_path / "out", FormulaPool(limit=0))


def test_every_evaluation_is_read_in_the_order_in_which_it_was_asked_for(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path, FormulaPool(workers=4), batch=3)
    results = load_runs(tmp_path)
    frame = results.evaluations
    assert list(frame.columns[:3]) == ["algorithm", "run", "evaluation"]
    for key in all_runs(study):
        of_run = frame[(frame["algorithm"] == key.algorithm) & (frame["run"] == key.run)]
        assert of_run["evaluation"].is_monotonic_increasing
        assert of_run["evaluation"].iloc[0] == 0
        assert of_run["evaluation"].iloc[-1] < study.search.evaluations
    assert results.solutions.to_csv(index=False, lineterminator="\n").encode() == solutions(tmp_path)
    assert results.manifest["study"] == tables_of(study)


@pytest.mark.parametrize("workers", [1, 4])
def test_a_forecast_counts_and_measures_the_search_itself(
    workers: int, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = iter(range(100_000))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(seconds)))
    pool = FormulaPool(workers)
    ahead = forecast(study, 6, pool)
    assert ahead.evaluations == 600
    assert ahead.seconds == pytest.approx(600 / ahead.rate)
    assert 600 * 8 * (12 + len(METRICS)) <= ahead.size <= 600 * 20 * (17 + len(METRICS))
    assert study.search.population / 4 < ahead.rate <= 6 * study.search.population, (
        "at most a generation of all runs in a second"
    )


class Deadly(FormulaPool):
    """A worker dies of low tyre friction, at every attempt or only at each setting's first."""

    def __init__(self, workers: int = 1, *, always: bool = True) -> None:
        super().__init__(workers)
        self._always = always
        self._killed = set[bytes]()

    def evaluate(self, work: bytes, settings: np.ndarray) -> Evaluations:
        deadly = {setting.tobytes() for setting in settings if setting[8] < 1.3}
        if deadly if self._always else not deadly <= self._killed:
            self._killed |= deadly
            raise Death("died")
        return super().evaluate(work, settings)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_settings_that_a_worker_dies_of_are_counted_kept_out_and_not_met_again(
    workers: int, study: Study, tmp_path: Path
) -> None:
    pool = Deadly(workers)
    campaign, _ = carried_out(study, tmp_path, pool)
    frame = load_runs(tmp_path).evaluations
    failed = frame["outcome"] == "simulator-error"
    assert failed.sum() == len(campaign.failures) > 0
    assert np.array_equal(failed, frame["tireFric"] < 1.3)
    assert not (load_runs(tmp_path).solutions["tireFric"] < 1.3).any()
    repeated = Counter(pool.simulated)
    del repeated[SUN.original.tobytes()]
    assert max(repeated.values()) <= 3, "an intact row is journalled at once: what kills a worker costs no other result"
    before = solutions(tmp_path)
    again, _ = carried_out(study, tmp_path, FormulaPool(limit=0))
    assert again.failures == campaign.failures
    assert solutions(tmp_path) == before


def test_a_worker_that_dies_once_leaves_the_same_bytes(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "whole")
    campaign, _ = carried_out(study, tmp_path / "out", Deadly(always=False))
    assert campaign.failures == []
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")


def test_a_worker_that_always_dies_outside_of_batches_ends_the_study(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: object) -> bool:
        raise Death("died in the search")

    monkeypatch.setattr(Run, "advance", die)
    with pytest.raises(WorkerLostError, match="died in the search"):
        carried_out(study, tmp_path)


class Outage(FormulaPool):
    """Cannot simulate low tyre friction today."""

    def evaluate(self, work: bytes, settings: np.ndarray) -> Evaluations:
        if np.any(settings[:, 8] < 1.3):
            raise SimulationError("SUMO failed: it has its day off")
        return super().evaluate(work, settings)


@pytest.mark.slow
def test_failed_settings_are_tried_again_when_that_is_asked_for(study: Study, tmp_path: Path) -> None:
    failed, _ = carried_out(study, tmp_path / "out", Outage())
    results = load_runs(tmp_path / "out")
    assert list(results.failures) == failed.failures != []
    assert {one.reason for one in failed.failures} == {"SUMO failed: it has its day off"}
    with pytest.raises(PoolLostError):  # a retry that breaks down is gone on with
        carried_out(study, tmp_path / "out", FormulaPool(limit=7), retry_failed=True)
    campaign, _ = carried_out(study, tmp_path / "out", retry_failed=True)
    carried_out(study, tmp_path / "whole")
    assert campaign.failures == []
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")
    pd.testing.assert_frame_equal(load_runs(tmp_path / "out").evaluations, load_runs(tmp_path / "whole").evaluations)
