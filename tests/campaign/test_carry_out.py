"""Runs driven over pools whose evaluations are formulas: reordered, alone and together, with more or fewer of them."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from safevar_sumo.api.running import CampaignProgress
from safevar_sumo.campaign import RunKey, all_runs, forecast, run_campaign
from safevar_sumo.campaign.batcher import BATCHES_PER_WORKER
from safevar_sumo.campaign.run import Run
from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results import Journal, ResultsDirectory, load_runs, status
from safevar_sumo.results.journal import read_journal
from safevar_sumo.search import Search
from safevar_sumo.study import MatrixTable, Study, tables_of
from safevar_sumo.workers.evaluation import PoolLostError, WorkerLostError
from tests.campaign.formulas import SUN, EventLog, FormulaPool, carried_out, evaluated, solutions, with_search


@pytest.mark.slow
def test_results_depend_neither_on_workers_nor_on_order_nor_on_batches(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "a")
    for name, pool, batch in (("b", FormulaPool(workers=7), None), ("c", FormulaPool(workers=3, shuffled=True), 3),
                              ("d", FormulaPool(workers=2, shuffled=True), 1)):
        carried_out(study, tmp_path / name, pool, batch=batch)
        assert solutions(tmp_path / name) == solutions(tmp_path / "a")
        pd.testing.assert_frame_equal(load_runs(tmp_path / name).evaluations, load_runs(tmp_path / "a").evaluations)


def test_bar_status_and_campaign_count_the_same_collisions(study: Study, tmp_path: Path) -> None:
    """Different settings of each run; the bar also when it goes on from finished journals."""
    for again in (False, True):
        shows, results = list[tuple[str, int, int]](), ResultsDirectory(tmp_path, study)
        progress = CampaignProgress(lambda *values, shows=shows: shows.append(values), study, all_runs(study))
        campaign = run_campaign(study, all_runs(study), results, FormulaPool(), progress)
        results.finish(campaign.solutions)
        evaluations = load_runs(tmp_path).evaluations
        expected = len(evaluations[evaluations["outcome"] == "collision"].drop_duplicates(["algorithm", "run", *SUN.names]))
        assert expected > 0
        assert sum(campaign.collisions.values()) == sum(run.collisions for run in status(tmp_path).runs) == expected
        stage, done, total = shows[-1]
        assert f" {expected} collisions" in stage
        assert done == total == (0 if again else study.search.evaluations * len(all_runs(study)))


class Sizes(FormulaPool):
    """Keeps the batches' sizes."""

    def __init__(self, workers: int) -> None:
        super().__init__(workers)
        self.sizes: list[int] = []

    def submit(self, study: bytes, settings: np.ndarray) -> Future[Evaluations]:
        self.sizes.append(len(settings))
        return super().submit(study, settings)


def test_runs_share_batches_and_one_run_is_shared_out(study: Study, tmp_path: Path) -> None:
    large = with_search(study, population=40, evaluations=400, runs=10, algorithms=["rs"])
    together, alone = Sizes(workers=2), Sizes(workers=2)
    carried_out(large, tmp_path / "together", together)
    carried_out(large, tmp_path / "alone", alone, keys=[RunKey("rs", 3)])
    assert np.mean(together.sizes[1:]) > 3 * large.search.population
    assert alone.sizes[1:3] == [20, 20]
    one, other = (load_runs(tmp_path / name).evaluations.query("algorithm == 'rs' and run == 3") for name in ("together", "alone"))
    pd.testing.assert_frame_equal(one.reset_index(drop=True), other.reset_index(drop=True))


class Colliding(FormulaPool):
    """Everybody collides, the original vehicle too."""

    def submit(self, study: bytes, settings: np.ndarray) -> Future[Evaluations]:
        future = Future[Evaluations]()
        future.set_result(replace(evaluated(settings), outcome=np.full(len(settings), "collision")))
        return future


def test_an_original_vehicle_that_collides_is_told(study: Study, tmp_path: Path) -> None:
    _, observer = carried_out(study, tmp_path / "unsafe", Colliding())
    assert [line for line in observer.warnings if "the original vehicle itself collides" in line] == observer.warnings != []
    assert carried_out(study, tmp_path / "safe")[1].warnings == []


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
        under_way = BATCHES_PER_WORKER * study.search.population
        assert len(first.simulated) + len(second.simulated) <= len(whole.simulated) + under_way


def test_a_finished_campaign_answers_without_simulating(study: Study, tmp_path: Path) -> None:
    first, observer = carried_out(study, tmp_path)
    before = solutions(tmp_path)
    again, observer_again = carried_out(study, tmp_path, FormulaPool(limit=0))
    assert solutions(tmp_path) == before
    assert again.failures == first.failures == []
    assert observer_again.simulated == 0
    assert observer_again.finished_runs == observer.finished_runs == dict.fromkeys(all_runs(study), study.search.evaluations)


def test_more_runs_extend_and_fewer_leave_out(study: Study, tmp_path: Path) -> None:
    pools = [FormulaPool() for _ in range(3)]
    carried_out(with_search(study, runs=3), tmp_path / "whole", pools[0])
    carried_out(with_search(study, runs=1), tmp_path / "grown", pools[1])
    carried_out(with_search(study, runs=3), tmp_path / "grown", pools[2])
    assert solutions(tmp_path / "grown") == solutions(tmp_path / "whole")
    assert len(pools[1].simulated) + len(pools[2].simulated) == len(pools[0].simulated), "each setting once"


@pytest.mark.parametrize("key", [RunKey("nsga2", 1), RunKey("rs", 0), RunKey("safe_fuzzer", 1)])
def test_a_run_alone_is_the_same_as_in_the_whole(study: Study, tmp_path: Path, key: RunKey) -> None:
    campaign, _ = carried_out(study, tmp_path / "whole")
    alone = run_campaign(study, [key], ResultsDirectory(tmp_path / "alone", study), FormulaPool(), EventLog())
    assert list(alone.solutions) == [key]
    assert np.array_equal(alone.solutions[key].settings, campaign.solutions[key].settings)
    assert np.array_equal(alone.solutions[key].objectives, campaign.solutions[key].objectives)


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
@pytest.mark.parametrize("budgets", [(60, 100), (55, 130), (100, 60), (550, 800)])
def test_more_or_fewer_evaluations_go_on_and_end_as_if_there_had_never_been_others(
        study: Study, tmp_path: Path, budgets: tuple[int, int]) -> None:
    first, second = (with_search(study, evaluations=budget, runs=1) for budget in budgets)
    pools = [FormulaPool() for _ in range(3)]
    carried_out(first, tmp_path / "out", pools[0])
    carried_out(second, tmp_path / "out", pools[1])
    carried_out(second, tmp_path / "fresh", pools[2])
    assert solutions(tmp_path / "out") == solutions(tmp_path / "fresh")
    results, fresh = load_runs(tmp_path / "out"), load_runs(tmp_path / "fresh")
    pd.testing.assert_frame_equal(results.evaluations, fresh.evaluations)
    pd.testing.assert_frame_equal(results.solutions, fresh.solutions)
    assert len(set(pools[0].simulated)) + len(set(pools[1].simulated)) == len(set(pools[0].simulated) | set(pools[1].simulated))
    carried_out(first, tmp_path / "out", FormulaPool(limit=0))


def test_every_evaluation_is_read_in_the_order_in_which_it_was_asked_for(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path, FormulaPool(workers=4, shuffled=True), batch=3)
    results = load_runs(tmp_path)
    frame = results.evaluations
    assert list(frame.columns[:3]) == ["algorithm", "run", "evaluation"]
    for key in all_runs(study):
        of_run = frame[(frame["algorithm"] == key.algorithm) & (frame["run"] == key.run)]
        assert of_run["evaluation"].is_monotonic_increasing
        assert of_run["evaluation"].iloc[0] == 0
        assert of_run["evaluation"].iloc[-1] < study.search.evaluations
    expected = evaluated(frame[list(SUN.names)].to_numpy())
    assert np.array_equal(frame["f_safe"], expected.f_safe)
    assert np.array_equal(frame["outcome"], expected.outcome)
    assert results.solutions.to_csv(index=False, lineterminator="\n").encode() == solutions(tmp_path)
    assert results.manifest["study"] == tables_of(study)


def test_a_forecast_counts_and_measures(study: Study) -> None:
    ahead = forecast(study, 6, FormulaPool())
    assert ahead.evaluations == 600
    assert ahead.seconds == pytest.approx(600 / ahead.rate)
    assert ahead.size >= 600 * 8 * (12 + len(METRICS))


@pytest.mark.parametrize("workers", [1, 4])
def test_a_forecast_tells_what_all_workers_do_together(workers: int, study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter(range(100))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(seconds)))
    pool = FormulaPool(workers)
    rate = forecast(study, 6, pool).rate
    assert rate == 4 / 5 * (len(pool.simulated) - workers), "settings of the second probe, in a second; the first one warms up"


def test_a_forecast_of_many_points_measures_few_vehicles(study: Study) -> None:
    rated, pool = msgspec.structs.replace(study, matrix=MatrixTable(protocol="euro_ncap_2026")), FormulaPool()
    forecast(rated, 6, pool)
    assert (1 + 4) * 1 <= len(pool.simulated) <= 1 + (1 + 4) * 8000 // 1859


def test_a_torn_tail_is_told_and_simulated_again(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path)
    before = solutions(tmp_path)
    torn = tmp_path / "runs" / "nsga2-01.journal"
    torn.write_bytes(torn.read_bytes()[:-700])
    pool = FormulaPool()
    _, observer = carried_out(study, tmp_path, pool)
    assert solutions(tmp_path) == before
    assert len(observer.warnings) == 1
    assert str(torn) in observer.warnings[0]
    assert 0 < len(pool.simulated) <= 2 * study.search.population


def test_a_setting_that_is_asked_for_twice_stands_where_it_was_asked_for_first(tmp_path: Path) -> None:
    settings = np.stack([SUN.original, SUN.lower, SUN.original])

    def twice() -> Search:
        return (yield settings).take([0])

    run = Run(RunKey("nsga2", 0), twice(), Journal(tmp_path / "a.journal", "study", "nsga2-00"), EventLog(), budget=3)
    assert not run.advance()
    assert run.receive(evaluated(run.missing_settings))
    run.advance()
    run.close()
    assert read_journal(tmp_path / "a.journal", "study", "nsga2-00").positions == [0, 1]


@pytest.mark.slow
def test_failures_are_counted_kept_out_and_not_met_again(study: Study, tmp_path: Path) -> None:
    class Deadly(FormulaPool):
        """A worker dies of low tyre friction."""

        def submit(self, work: bytes, settings: np.ndarray) -> Future[Evaluations]:
            if np.any(settings[:, 8] < 1.3):
                future: Future[Evaluations] = Future()
                future.set_exception(WorkerLostError("died"))
                return future
            return super().submit(work, settings)

    campaign, _ = carried_out(study, tmp_path, Deadly())
    frame = load_runs(tmp_path).evaluations
    failed = frame["outcome"] == "simulator-error"
    assert failed.sum() == len(campaign.failures) > 0
    assert np.array_equal(failed, frame["tireFric"] < 1.3)
    assert not (load_runs(tmp_path).solutions["tireFric"] < 1.3).any()
    before = solutions(tmp_path)
    again, _ = carried_out(study, tmp_path, FormulaPool(limit=0))
    assert again.failures == campaign.failures
    assert solutions(tmp_path) == before
    for path in (tmp_path / "runs").glob("*-*.journal"):
        path.write_bytes(path.read_bytes()[:-3])
    again, _ = carried_out(study, tmp_path, FormulaPool(limit=0))
    assert again.failures == campaign.failures
    assert solutions(tmp_path) == before


@pytest.mark.slow
def test_failed_settings_are_tried_again_when_that_is_asked_for(study: Study, tmp_path: Path) -> None:
    class Outage(FormulaPool):
        """Cannot simulate low tyre friction today."""

        def submit(self, work: bytes, settings: np.ndarray) -> Future[Evaluations]:
            if np.any(settings[:, 8] < 1.3):
                future: Future[Evaluations] = Future()
                future.set_exception(SimulationError("SUMO failed: it has its day off"))
                return future
            return super().submit(work, settings)

    failed, _ = carried_out(study, tmp_path / "out", Outage())
    results = load_runs(tmp_path / "out")
    assert list(results.failures) == failed.failures != []
    assert {one.reason for one in failed.failures} == {"SUMO failed: it has its day off"}
    with pytest.raises(PoolLostError):  # a retry that breaks down is gone on with
        run_campaign(study, all_runs(study), ResultsDirectory(tmp_path / "out", study), FormulaPool(limit=7), EventLog(), retry_failed=True)
    pool = FormulaPool()
    campaign = run_campaign(study, all_runs(study), ResultsDirectory(tmp_path / "out", study), pool, EventLog(), retry_failed=True)
    ResultsDirectory(tmp_path / "out", study).finish(campaign.solutions)
    carried_out(study, tmp_path / "whole")
    assert campaign.failures == []
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")
    pd.testing.assert_frame_equal(load_runs(tmp_path / "out").evaluations, load_runs(tmp_path / "whole").evaluations)
