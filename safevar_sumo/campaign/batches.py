"""Evaluation of many settings by a pool, in batches; and the files on which the results depend."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from safevar_sumo.campaign.checks import VERIFIED_SETTINGS, check_code, refuse_unlike_sumo, works_for_sumo
from safevar_sumo.campaign.evaluation import pack_study
from safevar_sumo.campaign.identity import Inputs, network_digests
from safevar_sumo.campaign.interrupts import wait_for_first, wait_for_result
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.campaign.retrying import RetryingPool
from safevar_sumo.errors import warn
from safevar_sumo.plugins import Files, digest_of, digests, file_by_name, files_named_in
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, fmus_of, user_code_names
from safevar_sumo.sumo import Engine, assemble, reason_for_sumo, settings_per_batch
from safevar_sumo.vehicles import CharacteristicSet

BATCHES_PER_CALL_AND_WORKER = 4
"""Number of batches per worker: with several small batches, no worker waits long for another."""
SMALLEST_BATCH = 1 / 20
"""Smallest batch, as a share of the most economical one: a smaller batch takes as long."""
_batch_sizes: dict[bytes, tuple[int, bool]] = {}
"""Results of `choose_batch_size`, by packed study."""
_verified_counts: dict[bytes, int] = {}
"""Number of settings with verified results, by packed study."""
_files_read: dict[tuple[bytes, str], Files] = {}
"""Files that models have read in this process, by packed study and working directory."""


def choose_batch_size(study: Study) -> tuple[int, bool]:
    """Choose the most economical number of settings in a batch; also returns whether a recorded scene can replace
    SUMO.
    """
    system = assemble(study, study.source)
    return settings_per_batch(system, Engine.RECORDED), not reason_for_sumo(system)


def evaluate_all(
    study: Study, settings: FloatArray, pool: Pool, done: Callable[[int], None] = lambda number: None
) -> Evaluations:
    """Evaluate M filtered settings of n characteristics, shape (M, n); equal settings are simulated once.

    User code is checked first (`check_code`). A sample of the settings in a recorded scene is also simulated in SUMO.
    `done` is called with the number of settings of every finished batch.
    """
    retrying_pool, work = RetryingPool(pool, study), pack_study(study, inputs := inputs_of(study, pool))
    for remark in check_code(study, inputs, retrying_pool):
        warn(remark)
    distinct_settings, row_of = np.unique(settings, axis=0, return_inverse=True)
    if work not in _batch_sizes:
        _batch_sizes[work] = choose_batch_size(study)
    best_size, is_recorded = _batch_sizes[work]
    share = len(distinct_settings) / (BATCHES_PER_CALL_AND_WORKER * pool.workers)
    size = min(best_size, math.ceil(max(share, SMALLEST_BATCH * best_size)))
    starts = range(0, len(distinct_settings), size)
    futures = {retrying_pool.submit(work, distinct_settings[start : start + size]): start for start in starts}
    sample_size = min(VERIFIED_SETTINGS - _verified_counts.get(work, 0), len(distinct_settings))
    sample = np.linspace(0, len(distinct_settings) - 1, sample_size).astype(int)
    sumo_future = recorded_future = None
    if is_recorded and len(sample):
        sumo_work, recorded_work = works_for_sumo(study, inputs)
        sumo_future = retrying_pool.submit(sumo_work, distinct_settings[sample])
        if recorded_work:
            recorded_future = retrying_pool.submit(recorded_work, distinct_settings[sample])
    evaluations_by_start: dict[int, Evaluations] = {}
    while len(evaluations_by_start) < len(futures):
        for future in wait_for_first(
            [future for future, start in futures.items() if start not in evaluations_by_start]
        ):
            batch = evaluations_by_start[futures[future]] = future.result()
            done(len(batch))
    evaluations = Evaluations.concatenate([evaluations_by_start[start] for start in starts])
    if sumo_future is not None:
        expected = evaluations.take(sample) if recorded_future is None else wait_for_result(recorded_future)
        refuse_unlike_sumo(study, expected.take(~expected.failed), wait_for_result(sumo_future).take(~expected.failed))
        _verified_counts[work] = _verified_counts.get(work, 0) + len(sample)
    return evaluations.take(row_of.ravel())


def ask_why_no_verdict(study: Study, pool: Pool) -> str:
    """Why simulations of a study tell nothing about its ADS, as `why_no_verdict` finds in a worker; "" if they do."""
    original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
    result = wait_for_result(
        RetryingPool(pool, study).submit(pack_study(study, inputs_of(study, pool), empty_road=True), original)
    )
    return "" if len(result) else next(iter(result.reasons.values()), "")  # a failed simulation has a row


def inputs_of(study: Study, pool: Pool) -> Inputs:
    """Digests of the files that must be the same on every worker, by layer and name; raises as `source_digests`."""
    return {"network": network_digests(assemble(study)), "sources": source_digests(study, pool)}


def source_digests(study: Study, pool: Pool) -> Files:
    """Digests, by name, of files that parameters name, and of files that user code reads while a worker simulates the
    original vehicle.

    The worker reloads all user code first.

    Raises
    ------
    SafevarError
        If the original vehicle cannot be simulated.
    """
    files = digests(files_named_in(_all_parameters(study), study.origin.places), study.origin.places)
    if user_code_names(study):
        work = pack_study(study, {}, afresh=True)
        key = work, os.getcwd()
        files_read = _files_read.get(
            key, {"": "never read"}
        )  # without an entry, a file that does not exist: its digest differs
        if any(digest_of(file_by_name(name, study.origin.places)) != digest for name, digest in files_read.items()):
            original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
            _files_read[key] = dict(
                wait_for_result(RetryingPool(pool, study).submit(work, original, must_succeed=True)).files
            )
        files |= _files_read[key]
    return dict(sorted(files.items()))


def _all_parameters(study: Study) -> list[Any]:
    """All parameters of the models and algorithms of a study, and the paths of its FMUs."""
    tests = [] if study.matrix is None else study.matrix.tests
    return [
        study.vehicle.parameters,
        study.ads.parameters,
        study.scenario.parameters,
        study.search.parameters,
        *(table for test in tests for table in (test.parameters, test.over)),
        [path for _, path in fmus_of(study)],
    ]
