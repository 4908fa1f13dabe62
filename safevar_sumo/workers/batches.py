"""Many settings of a study evaluated by a pool, in batches, and the files on which their results depend."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from safevar_sumo.errors import warn
from safevar_sumo.plugins import Files, digest_of, digests, located, named_files
from safevar_sumo.protocol.rater import driven_in_sumo
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, fmus_of, foreign_names
from safevar_sumo.sumo import Engine, assemble, reason_for_sumo, settings_per_batch
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.identity import Inputs, networks_of
from safevar_sumo.workers.interrupts import awaited, first_of
from safevar_sumo.workers.isolation import check_code, refuse_unlike_sumo
from safevar_sumo.workers.retrying import RetryingPool

SHARES = 4
"""Number of batches per worker, so that no worker waits long for another."""
LEAST_BATCH = 100
"""Least number of settings of a batch: a smaller one costs as much."""
VERIFIED = 50
"""Number of settings of a study, over all calls, that are also driven in SUMO; as many evaluations of each run are."""
_batches: dict[bytes, tuple[int, bool]] = {}
"""Results of `batches_of` by packed study."""
_verified: dict[bytes, int] = {}
"""Number of settings of a packed study that were also driven in SUMO, with the same results."""
_read: dict[tuple[bytes, str], Files] = {}
"""Files that models have read in this process, by packed study and working directory."""


def batches_of(study: Study) -> tuple[int, bool]:
    """The most economical number of settings in a batch, and whether they are driven in a recorded scene."""
    system = assemble(study, study.source)
    return settings_per_batch(system, Engine.RECORDED), not reason_for_sumo(system)


def evaluate_all(study: Study, settings: FloatArray, pool: Pool, done: Callable[[int], None] = lambda number: None) -> Evaluations:
    """Evaluate many filtered settings, shape (M, n), row by row; equal rows are simulated once.

    Code from outside is first checked (`check_code`), and a sample of the settings that are driven in a recorded
    scene is driven in SUMO too. `done` is called with the number of settings of every finished batch.
    """
    retrying, work = RetryingPool(pool, study), packed(study, inputs := inputs_of(study, pool))
    for remark in check_code(study, inputs, retrying):
        warn(remark)
    unique, row_of = np.unique(settings, axis=0, return_inverse=True)
    if work not in _batches:
        _batches[work] = batches_of(study)
    economical, recorded = _batches[work]
    size = min(economical, max(math.ceil(len(unique) / (SHARES * pool.workers)), LEAST_BATCH))
    starts = range(0, len(unique), size)
    futures = {retrying.submit(work, unique[start:start + size]): start for start in starts}
    sample = np.linspace(0, len(unique) - 1, min(VERIFIED - _verified.get(work, 0), len(unique))).astype(int)
    in_sumo = in_scenes = None
    if recorded and len(sample):
        sumo_study = driven_in_sumo(study, assemble(study).weather)
        sumo_inputs = inputs if sumo_study is study else inputs_of(sumo_study, pool)
        in_sumo = retrying.submit(packed(sumo_study, sumo_inputs, engine=Engine.LIBSUMO), unique[sample])
        if sumo_study is not study:
            in_scenes = retrying.submit(packed(sumo_study, sumo_inputs), unique[sample])
    parts: dict[int, Evaluations] = {}
    while len(parts) < len(futures):
        for future in first_of([future for future, start in futures.items() if start not in parts]):
            parts[futures[future]] = future.result()
            done(len(parts[futures[future]]))
    evaluations = Evaluations.concatenate([parts[start] for start in starts])
    if in_sumo is not None:
        expected = evaluations.take(sample) if in_scenes is None else awaited(in_scenes)
        refuse_unlike_sumo(study, expected.take(~expected.failed), awaited(in_sumo).take(~expected.failed))
        _verified[work] = _verified.get(work, 0) + len(sample)
    return evaluations.take(row_of.ravel())


def inputs_of(study: Study, pool: Pool) -> Inputs:
    """Digests of the files that must be the same on every worker, by layer and name; raises as `sources_of`."""
    return {"network": networks_of(assemble(study)), "sources": digests_of_sources(study, pool)}


def digests_of_sources(study: Study, pool: Pool) -> Files:
    """Digests, by name, of the files that models from outside read in one run of the original vehicle, and of files that parameters name.

    The run takes place in a worker that loads everything anew.

    Raises
    ------
    SafevarError
        If the original vehicle cannot be simulated.
    """
    files = digests(named_files(_parameters(study), study.origin.places), study.origin.places)
    if foreign_names(study):
        work = packed(study, {}, afresh=True)
        key = work, os.getcwd()
        if any(digest_of(located(name, study.origin.places)) != digest for name, digest in _read.get(key, {"": "never read"}).items()):
            original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
            _read[key] = dict(awaited(RetryingPool(pool, study).submit(work, original, must_succeed=True)).files)
        files |= _read[key]
    return dict(sorted(files.items()))


def _parameters(study: Study) -> list[Any]:
    """All parameters of a study's models and algorithms, and its FMUs."""
    tests = [] if study.matrix is None else study.matrix.tests
    return [study.vehicle.parameters, study.ads.parameters, study.scenario.parameters, study.search.parameters,
            *(table for test in tests for table in (test.parameters, test.over)), [path for _, path in fmus_of(study)]]
