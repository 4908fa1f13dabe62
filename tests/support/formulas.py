"""Campaigns whose settings are evaluated by a formula, in this process or in a thread for each
worker.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign import (
    RunKey,
    all_runs,
    campaign,
    evaluation,
    run_campaign,
    user_checks,
)
from safevar_sumo.campaign.evaluation import Task, evaluate_settings
from safevar_sumo.campaign.share import carry_share
from safevar_sumo.errors import SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Progress, show_no_progress
from tests.support.in_process import InlinePool
from tests.support.made_up import SUN, made_up_evaluations


def evaluated(settings: FloatArray) -> Evaluations:
    """Settings are safer the nearer they are to the original, measured by the sum of all relative
    changes.
    """
    share = (settings - SUN.original) / (SUN.upper - SUN.lower)
    safety = 3.0 - 4.0 * np.add.accumulate(np.abs(share), axis=1)[:, -1]
    metrics = {
        name: np.where(safety <= 0, np.nan, share[:, i])
        for i, name in enumerate(METRICS)
    }
    return made_up_evaluations(
        safety,
        settings=settings,
        f_diff=SUN.largest_change(settings),
        f_num_diff=SUN.number_changed(settings),
        metrics={**metrics, "safety_degree": safety},
    )


class FormulaPool(InlinePool):
    """Computes in this process, or in a thread for each worker; fails after `limit` batches."""

    def __init__(self, workers: int = 1, limit: int | None = None) -> None:
        super().__init__(workers)
        self._limit = limit
        self.received: list[bytes] = []
        self.sizes: list[int] = []
        self._threads = ThreadPoolExecutor(workers) if workers > 1 else None

    def evaluate(self, task: Task, settings: FloatArray) -> Evaluations:
        if self._limit is not None:
            if not self._limit:
                raise SafevarError("broken down")
            self._limit -= 1
        self.received += [row.tobytes() for row in settings]
        self.sizes.append(len(settings))
        return evaluated(settings)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        if self._threads:
            return self._threads.submit(self.compute, function, *arguments)
        return super().submit(function, *arguments)

    def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        if function in (carry_share, evaluate_settings):
            return function(*arguments)
        return ([], 0) if function is user_checks._refuse_defects else ""


def with_search(study: Study, **changes: object) -> Study:
    return load_study(study, search=changes)


def carried_out(
    study: Study,
    path: Path,
    pool: FormulaPool | None = None,
    keys: Sequence[RunKey] | None = None,
    batch: int | None = None,
    progress: Progress = show_no_progress,
) -> None:
    """Carry out a study whose results are not verified in SUMO."""
    pool = pool or FormulaPool()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "evaluate_batch", pool.evaluate)
        if batch is not None:
            patch.setattr(campaign, "efficient_batch", lambda system: batch)
        run_campaign(
            study,
            assemble(study),
            all_runs(study) if keys is None else keys,
            path,
            pool,
            progress,
            engine="sumo",
        )


def solutions(path: Path) -> bytes:
    return (path / "solutions.csv").read_bytes()
