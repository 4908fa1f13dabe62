"""Runs that break down, fail, and are read and resumed."""

from __future__ import annotations

import shutil
from concurrent.futures import Future
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from safevar_sumo.campaign import RunKey, all_runs, run_campaign
from safevar_sumo.campaign.run import Run
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import Evaluations
from safevar_sumo.results import Journal, ResultsDirectory, load
from safevar_sumo.results.journal import encoded, read_frames, read_journal
from safevar_sumo.search import Search
from safevar_sumo.study import Study
from safevar_sumo.workers.evaluation import PoolLostError, WorkerLostError
from tests.campaign.formulas import SUN, FormulaPool, Told, carried_out, evaluated, solutions, with_search


def test_a_torn_tail_is_told_and_simulated_again(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path)
    before = solutions(tmp_path)
    torn = tmp_path / "runs" / "nsga2-01.journal"
    torn.write_bytes(torn.read_bytes()[:-700])
    pool = FormulaPool()
    _, told = carried_out(study, tmp_path, pool)
    assert solutions(tmp_path) == before
    assert len(told.warnings) == 1
    assert str(torn) in told.warnings[0]
    assert 0 < len(pool.simulated) <= 2 * study.search.population


def test_a_setting_that_is_asked_for_twice_stands_where_it_was_asked_for_first(tmp_path: Path) -> None:
    settings = np.stack([SUN.original, SUN.lower, SUN.original])

    def twice() -> Search:
        return (yield settings).take([0])

    run = Run(RunKey("nsga2", 0), twice(), Journal(tmp_path / "a.journal", "study", "nsga2-00"), Told(), budget=3)
    assert not run.advance()
    assert run.take(evaluated(run.missing))
    run.advance()
    run.close()
    assert read_journal(tmp_path / "a.journal", "study", "nsga2-00").positions == [0, 1]


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
    frame = load(tmp_path).evaluations
    failed = frame["outcome"] == "simulator-error"
    assert failed.sum() == len(campaign.failures) > 0
    assert np.array_equal(failed, frame["tireFric"] < 1.3)
    assert not (load(tmp_path).solutions["tireFric"] < 1.3).any()
    before = solutions(tmp_path)
    again, _ = carried_out(study, tmp_path, FormulaPool(lasts=0))
    assert again.failures == campaign.failures
    assert solutions(tmp_path) == before
    for path in (tmp_path / "runs").glob("*-*.journal"):
        path.write_bytes(path.read_bytes()[:-3])
    again, _ = carried_out(study, tmp_path, FormulaPool(lasts=0))
    assert again.failures == campaign.failures
    assert solutions(tmp_path) == before


def test_a_journal_from_elsewhere_is_refused_by_readers(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "a")
    carried_out(with_search(study, seed=2), tmp_path / "b")
    shutil.copy(tmp_path / "b" / "runs" / "rs-01.journal", tmp_path / "a" / "runs")
    with pytest.raises(InputError, match=r"rs-01\.journal: belongs to another study, run or version"):
        load(tmp_path / "a")


def test_an_algorithm_that_asks_for_other_settings_than_its_journal_holds_is_told(study: Study, tmp_path: Path) -> None:
    one = with_search(study, algorithms=["rs"], runs=1)
    carried_out(one, tmp_path)
    path = tmp_path / "runs" / "rs-00.journal"
    frames, _ = read_frames(path.read_bytes(), path)
    other = msgspec.structs.replace(frames[1], settings=(np.frombuffer(frames[1].settings) * 1.01).tobytes())  # type: ignore[union-attr]
    path.write_bytes(b"".join(encoded(frame) for frame in [frames[0], other]))
    with pytest.raises(InputError, match="holds other settings than this search asks for"):
        carried_out(one, tmp_path)


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
    results = load(tmp_path / "out")
    assert list(results.failures) == failed.failures != []
    assert {one.reason for one in failed.failures} == {"SUMO failed: it has its day off"}
    with pytest.raises(PoolLostError):  # a retry that breaks down is gone on with
        run_campaign(study, all_runs(study), ResultsDirectory(tmp_path / "out", study), FormulaPool(lasts=7), Told(), retry_failed=True)
    pool = FormulaPool()
    campaign = run_campaign(study, all_runs(study), ResultsDirectory(tmp_path / "out", study), pool, Told(), retry_failed=True)
    ResultsDirectory(tmp_path / "out", study).finish(campaign.solutions)
    carried_out(study, tmp_path / "whole")
    assert campaign.failures == []
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")
    pd.testing.assert_frame_equal(load(tmp_path / "out").evaluations, load(tmp_path / "whole").evaluations)
