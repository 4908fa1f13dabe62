"""Runs driven over pools whose evaluations are formulas: resumed, reordered, alone and together."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from safevar_sumo.campaign import Campaign, RunKey, all_runs, carry_out, forecast, run_generator
from safevar_sumo.campaign.gathering import BATCHES_PER_WORKER
from safevar_sumo.computing import PoolLostError, WorkerLostError
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results import Journal, ResultsDirectory, load
from safevar_sumo.results.frames import encoded, read_frames
from safevar_sumo.study import Study, load_study, tables_of
from safevar_sumo.vehicles import CharacteristicSet

SUN = CharacteristicSet.of(load_study("sun").vehicle.characteristics)


def evaluated(settings: np.ndarray) -> Evaluations:
    """The safer, the nearer to the original; what only the sum over a row tells."""
    share = (settings - SUN.original) / (SUN.upper - SUN.lower)
    safety = 3.0 - 4.0 * np.add.accumulate(np.abs(share), axis=1)[:, -1]
    collided = safety <= 0
    return Evaluations(
        settings=settings, outcome=np.where(collided, "collision", "stopped").astype("U16"),
        collision_speed=np.where(collided, -safety, np.nan), f_diff=SUN.largest_change(settings), f_num_diff=SUN.number_changed(settings),
        metrics={name: safety if name == "safety_degree" else np.where(collided, np.nan, share[:, i]) for i, name in enumerate(METRICS)})


class FormulaPool:
    """Answers in the order of submission, or `shuffled` by threads; breaks down after `lasts` batches."""

    def __init__(self, workers: int = 1, lasts: int | None = None, shuffled: bool = False) -> None:
        self.workers, self._lasts = workers, lasts
        self.simulated: list[bytes] = []
        self._threads = ThreadPoolExecutor(4) if shuffled else None

    def submit(self, study: bytes, settings: np.ndarray) -> Future[Evaluations]:
        if self._lasts is not None:
            if not self._lasts:
                raise PoolLostError("broken down")
            self._lasts -= 1
        self.simulated += [row.tobytes() for row in settings]
        if self._threads:
            return self._threads.submit(evaluated, settings)
        future: Future[Evaluations] = Future()
        future.set_result(evaluated(settings))
        return future


class Told:
    """Keeps what an observer is told."""

    def __init__(self) -> None:
        self.simulated = self.asked = 0
        self.finished_runs: dict[RunKey, int] = {}
        self.warnings: list[str] = []

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        self.asked += len(evaluations)
        self.simulated += simulated

    def finished(self, key: RunKey, asked: int) -> None:
        self.finished_runs[key] = asked

    def warned(self, message: str) -> None:
        self.warnings.append(message)


@pytest.fixture
def study() -> Study:
    smoke = load_study("smoke")
    return msgspec.structs.replace(smoke, search=msgspec.structs.replace(smoke.search, algorithms=["nsga2", "rs", "safe_fuzzer"]))


def with_search(study: Study, **changes: object) -> Study:
    return msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, **changes))


def carried_out(study: Study, path: Path, pool: FormulaPool | None = None, keys: Iterable[RunKey] | None = None,
                batch: int | None = None) -> tuple[Campaign, Told]:
    told = Told()
    results = ResultsDirectory(path, study)
    campaign = carry_out(study, all_runs(study) if keys is None else keys, results, pool or FormulaPool(), told, batch)
    results.finish(campaign.solutions)
    return campaign, told


def solutions(path: Path) -> bytes:
    return (path / "solutions.csv").read_bytes()


def test_results_depend_neither_on_workers_nor_on_order_nor_on_batches(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "a")
    for name, pool, batch in (("b", FormulaPool(workers=7), None), ("c", FormulaPool(workers=3, shuffled=True), 3),
                              ("d", FormulaPool(workers=2, shuffled=True), 1)):
        carried_out(study, tmp_path / name, pool, batch=batch)
        assert solutions(tmp_path / name) == solutions(tmp_path / "a")
        pd.testing.assert_frame_equal(load(tmp_path / name).evaluations, load(tmp_path / "a").evaluations)


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
    one, other = (load(tmp_path / name).evaluations.query("algorithm == 'rs' and run == 3") for name in ("together", "alone"))
    pd.testing.assert_frame_equal(one.reset_index(drop=True), other.reset_index(drop=True))


def test_another_seed_finds_other_solutions(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "a")
    carried_out(with_search(study, seed=2), tmp_path / "b")
    assert solutions(tmp_path / "a") != solutions(tmp_path / "b")


def test_a_campaign_that_breaks_down_anywhere_is_resumed_where_it_was(study: Study, tmp_path: Path) -> None:
    whole = FormulaPool()
    carried_out(study, tmp_path / "whole", whole)
    for lasts in (1, 2, 3, 7, 20, 41):
        out, first, second = tmp_path / str(lasts), FormulaPool(lasts=lasts), FormulaPool()
        with pytest.raises(PoolLostError, match="broken down"):
            carried_out(study, out, first, batch=study.search.population)
        carried_out(study, out, second)
        assert solutions(out) == solutions(tmp_path / "whole")
        assert set(first.simulated + second.simulated) == set(whole.simulated)
        under_way = BATCHES_PER_WORKER * study.search.population
        assert len(first.simulated) + len(second.simulated) <= len(whole.simulated) + under_way


def test_a_finished_campaign_answers_without_simulating(study: Study, tmp_path: Path) -> None:
    first, told = carried_out(study, tmp_path)
    before = solutions(tmp_path)
    again, told_again = carried_out(study, tmp_path, FormulaPool(lasts=0))
    assert solutions(tmp_path) == before
    assert again.failures == first.failures == []
    assert told_again.simulated == 0
    assert told_again.finished_runs == told.finished_runs == dict.fromkeys(all_runs(study), study.search.evaluations)


def test_a_setting_is_simulated_once_in_a_run(study: Study, tmp_path: Path) -> None:
    one = with_search(study, algorithms=["nsga2"], runs=1)
    pool = FormulaPool()
    _, told = carried_out(one, tmp_path, pool)
    assert len(pool.simulated) == len(set(pool.simulated)) == told.simulated + 1
    assert told.simulated <= told.asked == study.search.evaluations


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
    alone = carry_out(study, [key], ResultsDirectory(tmp_path / "alone", study), FormulaPool(), Told())
    assert list(alone.solutions) == [key]
    assert np.array_equal(alone.solutions[key].settings, campaign.solutions[key].settings)
    assert np.array_equal(alone.solutions[key].objectives, campaign.solutions[key].objectives)


def test_runs_have_random_numbers_of_their_own(study: Study) -> None:
    first = {tuple(run_generator(study, key).random(3)) for key in all_runs(with_search(study, runs=30))}
    assert len(first) == 90
    one, other = (run_generator(which, RunKey("rs", 7)).random(3) for which in (study, with_search(study, runs=9)))
    assert np.array_equal(one, other)


def test_a_run_in_other_hands_is_left_to_them(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path / "whole")
    results = ResultsDirectory(tmp_path / "out", study)
    theirs = [results.journal("rs-01"), results.journal("original")]
    campaign = carry_out(study, all_runs(study), results, FormulaPool(), Told())
    assert campaign.busy == [RunKey("rs", 1)]
    assert set(campaign.solutions) == set(all_runs(study)) - {RunKey("rs", 1)}
    for journal in theirs:
        journal.close()
    carried_out(study, tmp_path / "out")
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")


def test_journals_are_given_back_whatever_happens(study: Study, tmp_path: Path) -> None:
    with pytest.raises(PoolLostError):
        carried_out(study, tmp_path, FormulaPool(lasts=5))
    for path in (tmp_path / "runs").iterdir():
        results = ResultsDirectory(tmp_path, study)
        results.journal(path.stem).close()


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


@pytest.mark.parametrize("budgets", [(60, 100), (55, 130), (100, 60), (550, 800)])
def test_more_or_fewer_evaluations_go_on_and_end_as_if_there_had_never_been_others(
        study: Study, tmp_path: Path, budgets: tuple[int, int]) -> None:
    first, second = (with_search(study, evaluations=budget, runs=1) for budget in budgets)
    pools = [FormulaPool() for _ in range(3)]
    carried_out(first, tmp_path / "out", pools[0])
    carried_out(second, tmp_path / "out", pools[1])
    carried_out(second, tmp_path / "fresh", pools[2])
    assert solutions(tmp_path / "out") == solutions(tmp_path / "fresh")
    found, fresh = load(tmp_path / "out"), load(tmp_path / "fresh")
    pd.testing.assert_frame_equal(found.evaluations, fresh.evaluations)
    pd.testing.assert_frame_equal(found.solutions, fresh.solutions)
    assert len(set(pools[0].simulated)) + len(set(pools[1].simulated)) == len(set(pools[0].simulated) | set(pools[1].simulated))
    carried_out(first, tmp_path / "out", FormulaPool(lasts=0))


def test_while_there_are_more_evaluations_to_come_a_run_is_unfinished(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path)
    with pytest.raises(PoolLostError):
        carried_out(with_search(study, evaluations=300), tmp_path, FormulaPool(lasts=3))
    found = load(tmp_path)
    assert found.finished == ()
    assert not (tmp_path / "solutions.csv").exists()


def test_the_manifest_tells_what_counts(study: Study, tmp_path: Path) -> None:
    carried_out(with_search(study, runs=3), tmp_path)
    carried_out(with_search(study, runs=1, algorithms=["nsga2", "rs"]), tmp_path, FormulaPool(lasts=0))
    found = load(tmp_path)
    assert found.finished == (("nsga2", 0), ("rs", 0))
    assert set(found.evaluations["run"]) == {0}
    assert found.solutions.to_csv(index=False, lineterminator="\n").encode() == solutions(tmp_path)


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
        carry_out(study, all_runs(study), ResultsDirectory(tmp_path / "out", study), FormulaPool(lasts=7), Told(), retry_failed=True)
    pool = FormulaPool()
    campaign = carry_out(study, all_runs(study), ResultsDirectory(tmp_path / "out", study), pool, Told(), retry_failed=True)
    ResultsDirectory(tmp_path / "out", study).finish(campaign.solutions)
    carried_out(study, tmp_path / "whole")
    assert campaign.failures == []
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")
    pd.testing.assert_frame_equal(load(tmp_path / "out").evaluations, load(tmp_path / "whole").evaluations)


def test_a_torn_journal_of_the_original_is_told_too(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path)
    torn = tmp_path / "runs" / "original.journal"
    torn.write_bytes(torn.read_bytes()[:-5])
    _, told = carried_out(study, tmp_path)
    assert len(told.warnings) == 1
    assert str(torn) in told.warnings[0]


def test_every_evaluation_is_read_in_the_order_in_which_it_was_asked_for(study: Study, tmp_path: Path) -> None:
    carried_out(study, tmp_path, FormulaPool(workers=4, shuffled=True), batch=3)
    results = load(tmp_path)
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


def test_an_unfinished_directory_is_read_too(study: Study, tmp_path: Path) -> None:
    pool = FormulaPool(lasts=15)
    with pytest.raises(PoolLostError):
        carried_out(study, tmp_path, pool, batch=study.search.population)
    results = load(tmp_path)
    in_flight = study.search.population
    assert len(pool.simulated) - 1 - in_flight <= len(results.evaluations) <= len(pool.simulated) - 1, "all but the original vehicle's"
    assert set(results.solutions["algorithm"]) <= {"nsga2"}


def test_a_forecast_counts_and_measures(study: Study) -> None:
    told = forecast(study, 6, FormulaPool())
    assert told.evaluations == 600
    assert told.seconds == pytest.approx(600 / told.rate)
    assert told.size >= 600 * 8 * (12 + len(METRICS))


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


def test_a_journal_that_cannot_be_written_ends_the_campaign(study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from safevar_sumo.errors import SafevarError

    written = Journal.append

    def full(self: Journal, positions: list[int], evaluations: Evaluations) -> None:
        if self.path.stat().st_size > 8000:
            raise SafevarError("full")
        written(self, positions, evaluations)

    monkeypatch.setattr(Journal, "append", full)
    with pytest.raises(SafevarError, match="full"):
        carried_out(study, tmp_path / "out")
    monkeypatch.undo()
    assert len(load(tmp_path / "out").evaluations) > 0
    carried_out(study, tmp_path / "out")
    carried_out(study, tmp_path / "whole")
    assert solutions(tmp_path / "out") == solutions(tmp_path / "whole")
