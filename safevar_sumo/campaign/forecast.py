"""Estimate of a campaign's cost, measured by a short probe."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine
from safevar_sumo.sumo.matrix import LARGEST_WORLD
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.interrupts import awaited
from safevar_sumo.workers.retrying import RetryingPool

PROBE_BATCHES = 4
"""Number of batches per worker in the measurement."""
NUMBERS_BESIDE_METRICS = 4
"""A journal keeps f_diff, f_num_diff, the collision's speed and a position and outcome with the metrics of a setting."""


class Forecast(NamedTuple):
    """Largest number of evaluations, evaluations per second, and largest numbers of seconds and bytes of a campaign."""

    evaluations: int
    rate: float
    seconds: float
    size: int


def forecast(study: Study, runs: int, pool: Pool, batch: int = LARGEST_WORLD, engine: Engine = Engine.LIBSUMO) -> Forecast:
    """The largest cost of `runs` runs, estimated by a short probe of the pool that will carry them out."""
    characteristics, size = CharacteristicSet.of(study.vehicle.characteristics), min(batch, max(runs, 1) * study.search.population)
    retrying, work, rng = RetryingPool(pool, study), packed(study, engine=engine), np.random.default_rng(study.search.seed)

    def probe(number: int) -> float:
        """Seconds that `number` batches on every worker take."""
        start = time.perf_counter()
        drawn = [characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (size, len(characteristics))))
                 for _ in range(number * pool.workers)]
        for future in [retrying.submit(work, settings) for settings in drawn]:
            awaited(future)
        return time.perf_counter() - start

    awaited(retrying.submit(work, characteristics.original[np.newaxis], must_succeed=True))
    probe(1)  # starts the workers and builds the network
    rate = PROBE_BATCHES * pool.workers * size / probe(PROBE_BATCHES)
    evaluations = runs * study.search.evaluations
    row = 8 * (len(characteristics) + len(METRICS) + NUMBERS_BESIDE_METRICS)
    return Forecast(evaluations, rate, evaluations / rate, evaluations * row)
