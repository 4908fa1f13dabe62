"""Many settings of a study evaluated by a pool, in batches."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.isolation import check_isolation
from safevar_sumo.workers.local import first_of
from safevar_sumo.workers.retrying import RetryingPool
from safevar_sumo.workers.sources import inputs_of

BATCH = 100
"""Settings per SUMO simulation."""
_isolated: set[bytes] = set()
"""Packed studies whose models have been seen to keep settings apart."""


def evaluate_all(study: Study, settings: FloatArray, pool: Pool, done: Callable[[int], None] = lambda number: None, *,
                 alone: bool = False) -> Evaluations:
    """Evaluate many filtered settings, shape (M, n), row by row; equal rows are simulated once, `alone` as in `packed`.

    Models that are not ours are first seen to keep settings apart (`check_isolation`). `done` is called with the number of
    settings of every batch that is finished.
    """
    persistent, work = RetryingPool(pool, study), packed(study, inputs_of(study, pool), alone=alone)
    if work not in _isolated:
        check_isolation(study, CharacteristicSet.of(study.vehicle.characteristics), lambda rows: persistent.submit(work, rows))
        _isolated.add(work)
    unique, row_of = np.unique(settings, axis=0, return_inverse=True)
    starts = range(0, len(unique), BATCH)
    futures = {persistent.submit(work, unique[start:start + BATCH]): start for start in starts}
    parts: dict[int, Evaluations] = {}
    while len(parts) < len(futures):
        for future in first_of([future for future, start in futures.items() if start not in parts]):
            parts[futures[future]] = future.result()
            done(len(parts[futures[future]]))
    return Evaluations.concatenate([parts[start] for start in starts]).take(row_of.ravel())
