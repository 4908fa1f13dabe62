"""Campaigns over pools that evaluate settings by a formula."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import msgspec
import numpy as np

from safevar_sumo.campaign import Campaign, RunKey, all_runs, run_campaign
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import PoolLostError

SUN = CharacteristicSet.of(load_study("sun").vehicle.characteristics)


def evaluated(settings: np.ndarray) -> Evaluations:
    """Settings are safer the nearer they are to the original, measured by the sum of all relative changes."""
    share = (settings - SUN.original) / (SUN.upper - SUN.lower)
    safety = 3.0 - 4.0 * np.add.accumulate(np.abs(share), axis=1)[:, -1]
    collided = safety <= 0
    return Evaluations(
        settings=settings, outcome=np.where(collided, "collision", "stopped").astype("U16"),
        collision_speed=np.where(collided, -safety, np.nan), f_diff=SUN.largest_change(settings), f_num_diff=SUN.number_changed(settings),
        metrics={name: safety if name == "safety_degree" else np.where(collided, np.nan, share[:, i]) for i, name in enumerate(METRICS)})


class FormulaPool:
    """Answers in the order of submission or, if `shuffled`, in the order of threads; fails after `limit` batches."""

    def __init__(self, workers: int = 1, limit: int | None = None, shuffled: bool = False) -> None:
        self.workers, self._limit = workers, limit
        self.simulated: list[bytes] = []
        self._threads = ThreadPoolExecutor(4) if shuffled else None

    def submit(self, study: bytes, settings: np.ndarray) -> Future[Evaluations]:
        if self._limit is not None:
            if not self._limit:
                raise PoolLostError("broken down")
            self._limit -= 1
        self.simulated += [row.tobytes() for row in settings]
        if self._threads:
            return self._threads.submit(evaluated, settings)
        future: Future[Evaluations] = Future()
        future.set_result(evaluated(settings))
        return future


class EventLog:
    """An observer that records all reports."""

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


def with_search(study: Study, **changes: object) -> Study:
    return msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, **changes))


def carried_out(study: Study, path: Path, pool: FormulaPool | None = None, keys: Iterable[RunKey] | None = None,
                batch: int | None = None) -> tuple[Campaign, EventLog]:
    observer = EventLog()
    results = ResultsDirectory(path, study)
    campaign = run_campaign(study, all_runs(study) if keys is None else keys, results, pool or FormulaPool(), observer, batch)
    results.finish(campaign.solutions)
    return campaign, observer


def solutions(path: Path) -> bytes:
    return (path / "solutions.csv").read_bytes()
