"""Runs carried by pools whose evaluations are formulas: in any shares, alone and together, with more or fewer
evaluations.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.campaign import RunKey, all_runs, forecast, run_campaign
from safevar_sumo.campaign.campaign import deal
from safevar_sumo.campaign.pool import WorkerLostError
from safevar_sumo.campaign.run import RANDOM_SAMPLES, Run
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.results import Journal, ResultsDirectory, journal_head, load_runs
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.study import Study, load_study
from tests.campaign.formulas import SUN, Death, EventLog, FormulaPool, carried_out, evaluated, solutions, with_search


@pytest.fixture
def study() -> Study:
    return load_study("smoke", search={"algorithms": sorted(ALGORITHMS)})


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


def test_a_run_in_other_hands_is_left_to_them(study: Study, tmp_path: Path) -> None:
    study = with_search(study, algorithms=["nsga2", "rs"])
    carried_out(study, tmp_path / "whole")
    results = ResultsDirectory(tmp_path / "out", study)
    theirs = [results.journal("rs-01"), results.journal("original")]
    campaign = run_campaign(study, all_runs(study), results, FormulaPool(), log := EventLog())
    assert campaign.busy == [RunKey("rs", 1)]
    assert set(campaign.solutions) == set(all_runs(study)) - {RunKey("rs", 1)}
    assert set(log.finished_runs.values()) == {study.search.evaluations}
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
    before, after = FormulaPool(), FormulaPool()
    carried_out(first, tmp_path / "out", before)
    carried_out(second, tmp_path / "out", after)
    carried_out(second, tmp_path / "fresh")
    assert solutions(tmp_path / "out") == solutions(tmp_path / "fresh")
    results, fresh = load_runs(tmp_path / "out"), load_runs(tmp_path / "fresh")
    pd.testing.assert_frame_equal(results.evaluations, fresh.evaluations)
    assert not {*before.simulated} & {*after.simulated}
    carried_out(first, tmp_path / "out", FormulaPool(limit=0))


def journaled(evaluations: Evaluations, budget: int, path: Path) -> Run:
    """A run that has ended, and whose journal has evaluations."""
    head = journal_head("study", "rs-00", SUN.names)
    journal = Journal(path / "rs-00.jsonl", head)
    journal.append(range(len(evaluations)), evaluations)
    journal.finish([0], budget, budget)
    journal.close()
    return Run(RunKey("rs", 0), iter(()), Journal(journal.path, head), budget)  # type: ignore[arg-type]


def test_the_worst_and_the_last_evaluation_are_repeated_alone(tmp_path: Path) -> None:
    settings = SUN.original + np.linspace(1, 0, 99)[:, np.newaxis] * (SUN.upper - SUN.original)
    worst, last, *others = journaled(evaluated(settings), 99, tmp_path).sample_evaluations(np.random.default_rng(1))
    assert np.array_equal(np.concatenate([worst.settings, last.settings]), settings[[0, -1]])
    assert len(others) == RANDOM_SAMPLES


@pytest.mark.parametrize("outcome", [Outcome.COLLISION, Outcome.INVALID_TEST, Outcome.SIMULATOR_ERROR])
def test_what_a_longer_run_found_after_its_budget_is_not_counted(outcome: Outcome, tmp_path: Path) -> None:
    """A journal of two settings, and a run of one evaluation."""
    both = evaluated(np.stack([SUN.original, SUN.upper]))
    both = dataclasses.replace(both, outcome=np.array(["stopped", outcome.value]))
    result = journaled(both, 1, tmp_path).finish()
    assert (result.progress.collisions, result.invalid_tests, result.failures) == (0, 0, [])
    assert result.progress.best == both.f_safe[0]


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


def test_a_worker_that_always_dies_outside_of_batches_ends_the_study(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: object) -> bool:
        raise Death("died in the search")

    monkeypatch.setattr(Run, "advance", die)
    with pytest.raises(WorkerLostError, match="died in the search"):
        carried_out(study, tmp_path)
