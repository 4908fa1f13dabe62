"""Estimate of the cost of a campaign, from a short measurement of the same campaign."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec

from safevar_sumo.campaign.batches import source_digests
from safevar_sumo.campaign.campaign import run_campaign
from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.campaign.keys import all_runs
from safevar_sumo.campaign.pool import Pool, RunProgress
from safevar_sumo.metrics import METRICS
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine, assemble
from safevar_sumo.sumo.matrix import MAX_COPIES, MAX_VEHICLES
from safevar_sumo.vehicles import CharacteristicSet

PROBE_VEHICLES = 2 * MAX_VEHICLES
"""Largest number of vehicles in a batch of the measurement, over all points of a matrix."""
PROBE_SECONDS = 2.0
"""Shortest measurement [s], unless the runs are over before."""
CHARACTERS_PER_NUMBER = 18
"""Characters of a number in a journal, at most, with its comma."""
NUMBERS_BESIDE_METRICS = 5
"""Values in a journal besides the metrics of a setting: f_diff, f_num_diff, collision speed, position, outcome."""


class Forecast(NamedTuple):
    """Upper limits for a campaign: evaluations, `seconds`, and `size` of the results [bytes]; `rate` is in evaluations
    per second.
    """

    evaluations: int
    rate: float
    seconds: float
    size: int


class _Enough(Exception):
    """The measurement is long enough."""


class _Stopwatch:
    """Measures the evaluations per second of all workers together, from the first batch of the last worker on."""

    def __init__(self, run_count: int) -> None:
        self._run_count = run_count
        self._asked: dict[object, int] = {}
        self._start = (time.perf_counter(), 0)
        self._is_warm = False
        self.rate = 0.0

    def progressed(self, runs: Sequence[RunProgress]) -> None:
        self._asked |= {run.key: run.asked for run in runs}
        now, asked = time.perf_counter(), sum(self._asked.values())
        if asked > self._start[1]:
            self.rate = (asked - self._start[1]) / (now - self._start[0])
        if not self._is_warm and len(self._asked) == self._run_count:
            self._is_warm, self._start = True, (now, asked)
        elif self._is_warm and now - self._start[0] > PROBE_SECONDS:
            raise _Enough

    def finished(self, run: RunProgress) -> None:
        self.progressed([run])

    def warned(self, message: str) -> None: ...


def forecast(
    study: Study, runs: int, pool: Pool, batch: int = MAX_COPIES, engine: Engine = Engine.RECORDED
) -> Forecast:
    """Estimate upper limits for a number of runs, from a short measurement of some of them in a temporary directory."""
    system = assemble(study, study.source)
    settings_at_once = min(batch, max(PROBE_VEHICLES // len(system.points), 1))
    search = study.search
    probe = msgspec.structs.replace(
        study, search=msgspec.structs.replace(search, population=min(search.population, settings_at_once))
    )
    runs_of_worker = min(math.ceil(settings_at_once / probe.search.population), math.ceil(runs / pool.workers))
    keys = all_runs(probe)[: max(runs_of_worker, 1) * pool.workers]
    stopwatch = _Stopwatch(len(keys))
    with tempfile.TemporaryDirectory(prefix="safevar-", ignore_cleanup_errors=True) as folder:
        identity = identity_of(probe, system, source_digests(probe, pool))
        results = ResultsDirectory(Path(folder), probe, identity, system.measuring.scoring)
        with suppress(_Enough):
            run_campaign(probe, keys, results, pool, stopwatch, batch, engine=engine)
    evaluations = runs * search.evaluations
    numbers = len(CharacteristicSet.of(study.vehicle.characteristics)) + len(METRICS) + NUMBERS_BESIDE_METRICS
    return Forecast(
        evaluations, stopwatch.rate, evaluations / stopwatch.rate, evaluations * numbers * CHARACTERS_PER_NUMBER
    )
