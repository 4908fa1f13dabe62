"""What a study would take."""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.campaign import forecast
from safevar_sumo.metrics import METRICS
from safevar_sumo.study import Study
from safevar_sumo.workers.evaluation import PoolLostError
from tests.campaign.formulas import FormulaPool, carried_out, with_search


def test_a_forecast_counts_and_measures(study: Study) -> None:
    told = forecast(study, 6, FormulaPool())
    assert told.evaluations == 600
    assert told.seconds == pytest.approx(600 / told.rate)
    assert told.size >= 600 * 8 * (12 + len(METRICS))


def test_a_share_without_a_run_takes_nothing(study: Study) -> None:
    assert forecast(study, 0, FormulaPool())[2:] == (0, 0)


@pytest.mark.parametrize("workers", [1, 4])
def test_a_forecast_tells_what_all_workers_do_together(workers: int, study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter(range(100))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(seconds)))
    pool = FormulaPool(workers)
    rate = forecast(study, 6, pool).rate
    assert rate == 4 / 5 * (len(pool.simulated) - 1), "settings of the second probe, in a second; the first one warms up"


def test_a_forecast_of_a_study_at_fault_tells_the_fault(study: Study) -> None:
    with pytest.raises(PoolLostError):
        forecast(study, 6, FormulaPool(lasts=0))
    with pytest.raises(PoolLostError):
        forecast(study, 6, FormulaPool(lasts=2))


def test_the_size_that_is_forecast_is_the_size_of_the_journals(study: Study, tmp_path: Path) -> None:
    large = with_search(study, population=50, evaluations=500, runs=1)
    carried_out(large, tmp_path)
    size = sum(path.stat().st_size for path in (tmp_path / "runs").glob("*-*.journal"))
    assert size == pytest.approx(forecast(large, 3, FormulaPool()).size, rel=0.1)
