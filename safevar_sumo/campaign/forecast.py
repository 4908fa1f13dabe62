"""Estimate of the cost of a campaign, from a short measurement."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine
from safevar_sumo.sumo.matrix import MAX_COPIES, MAX_VEHICLES
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool, pack_study
from safevar_sumo.workers.interrupts import wait_for_result
from safevar_sumo.workers.retrying import RetryingPool

PROBE_BATCHES = 4
"""Number of batches per worker in the measurement."""
PROBE_VEHICLES = 4 * MAX_VEHICLES
"""Largest number of vehicles in a batch of the measurement, over all points of a matrix."""
SLOW_BATCH = 2.0
"""Time of a batch from which on one per worker is enough for the measurement [s]."""
NUMBERS_BESIDE_METRICS = 4
"""Numbers in a journal besides the metrics of a setting: f_diff, f_num_diff, collision speed, and position with outcome."""


class Forecast(NamedTuple):
    """Upper limits for a campaign: evaluations, `seconds`, and `size` of the results [bytes]; `rate` is in evaluations per second."""

    evaluations: int
    rate: float
    seconds: float
    size: int


def forecast(study: Study, runs: int, pool: Pool, batch: int = MAX_COPIES, engine: Engine = Engine.LIBSUMO) -> Forecast:
    """Estimate upper limits for a number of runs, from a short measurement of the pool that will carry out the runs."""
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    settings_at_once = max(PROBE_VEHICLES // len(assemble(study, study.source).points), 1)
    batch_size = min(batch, max(runs, 1) * study.search.population, settings_at_once)
    retrying_pool, work, rng = RetryingPool(pool, study), pack_study(study, engine=engine), np.random.default_rng(study.search.seed)

    def measure_time(batches_per_worker: int) -> float:
        """Time for a number of batches on every worker [s]."""
        start = time.perf_counter()
        batches = [characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (batch_size, len(characteristics))))
                   for _ in range(batches_per_worker * pool.workers)]
        for future in [retrying_pool.submit(work, settings) for settings in batches]:
            wait_for_result(future)
        return time.perf_counter() - start

    original = characteristics.original[np.newaxis]
    for future in [retrying_pool.submit(work, original, must_succeed=True) for _ in range(pool.workers)]:
        wait_for_result(future)  # every worker starts, and builds the networks
    batches = PROBE_BATCHES if measure_time(1) < SLOW_BATCH else 1
    rate = batches * pool.workers * batch_size / measure_time(batches)
    evaluations = runs * study.search.evaluations
    row_size = 8 * (len(characteristics) + len(METRICS) + NUMBERS_BESIDE_METRICS)
    return Forecast(evaluations, rate, seconds=evaluations / rate, size=evaluations * row_size)
