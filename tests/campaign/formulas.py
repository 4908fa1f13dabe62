"""Campaigns over pools that evaluate settings by a formula."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from safevar_sumo.campaign import Campaign, RunKey, RunProgress, all_runs, run_campaign
from safevar_sumo.campaign.pool import Job, PoolLostError, Report, WorkerLostError
from safevar_sumo.campaign.worker import carry_out_job
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import InlinePool
from tests.made_up import made_up_evaluations

SUN = CharacteristicSet.of(load_study("sun"))


def evaluated(settings: FloatArray) -> Evaluations:
    """Settings are safer the nearer they are to the original, measured by the sum of all relative changes."""
    share = (settings - SUN.original) / (SUN.upper - SUN.lower)
    safety = 3.0 - 4.0 * np.add.accumulate(np.abs(share), axis=1)[:, -1]
    metrics = {name: np.where(safety <= 0, np.nan, share[:, i]) for i, name in enumerate(METRICS)}
    return made_up_evaluations(
        safety,
        settings=settings,
        f_diff=SUN.largest_change(settings),
        f_num_diff=SUN.number_changed(settings),
        metrics={**metrics, "safety_degree": safety},
    )


class Death(BaseException):
    """The end of a worker that carries a share."""


class FormulaPool(InlinePool):
    """Computes in this process, or in a thread for each worker; fails after `limit` batches."""

    def __init__(self, workers: int = 1, limit: int | None = None) -> None:
        self.workers, self._limit = workers, limit
        self.simulated: list[bytes] = []
        self.sizes: list[int] = []
        self._threads = ThreadPoolExecutor(workers) if workers > 1 else None

    def evaluate(self, packed_task: bytes, settings: FloatArray) -> Evaluations:
        if self._limit is not None:
            if not self._limit:
                raise PoolLostError("broken down")
            self._limit -= 1
        self.simulated += [row.tobytes() for row in settings]
        self.sizes.append(len(settings))
        return evaluated(settings)

    def carry(self, job: Job, report: Report) -> Future[None]:
        return self._threads.submit(self.work, job, report) if self._threads else super().carry(job, report)

    def work(self, job: Job, report: Report) -> None:
        try:
            carry_out_job(job, report, self.evaluate)
        except Death as death:
            raise WorkerLostError(str(death)) from None


class EventLog:
    """An observer that records all reports."""

    def __init__(self) -> None:
        self.runs: dict[RunKey, RunProgress] = {}
        self.finished_runs: dict[RunKey, int] = {}
        self.warnings: list[str] = []

    @property
    def simulated(self) -> int:
        return sum(run.asked - run.replayed for run in self.runs.values())

    def progressed(self, runs: Sequence[RunProgress]) -> None:
        self.runs |= {run.key: run for run in runs}

    def finished(self, run: RunProgress) -> None:
        self.runs[run.key], self.finished_runs[run.key] = run, run.asked

    def warned(self, message: str) -> None:
        self.warnings.append(message)


def with_search(study: Study, **changes: object) -> Study:
    return load_study(study, search=changes)


def carried_out(
    study: Study,
    path: Path,
    pool: FormulaPool | None = None,
    keys: Iterable[RunKey] | None = None,
    batch: int | None = None,
    **options: bool,
) -> tuple[Campaign, EventLog]:
    observer = EventLog()
    results = ResultsDirectory(path, study)
    campaign = run_campaign(
        study, all_runs(study) if keys is None else keys, results, pool or FormulaPool(), observer, batch, **options
    )
    results.finish(campaign.solutions)
    return campaign, observer


def solutions(path: Path) -> bytes:
    return (path / "solutions.csv").read_bytes()
