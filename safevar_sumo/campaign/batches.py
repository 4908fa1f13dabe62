"""Evaluation of many settings by a pool, in batches; checks of results; and the files on which the results depend."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from typing import Any

import numpy as np
import platformdirs

from safevar_sumo.campaign.evaluation import EVERYTHING, Inputs, Selection, network_digests, pack_study
from safevar_sumo.campaign.pool import Pool, wait_for_first, wait_for_result
from safevar_sumo.campaign.retrying import RetryingPool
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins import Files, digest_of, digests, file_by_name, files_named_in
from safevar_sumo.protocol.rater import study_for_sumo_check
from safevar_sumo.records import ROUNDING, Evaluations, FloatArray, differences
from safevar_sumo.results import RESULTS
from safevar_sumo.study import Study, fmus_of, tables_of, user_code_names
from safevar_sumo.sumo import Engine, assemble, is_recorded, settings_per_batch

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
VERIFIED_SETTINGS = 50
"""Number of settings to verify in SUMO: of a study in questions; and of each run of a campaign, besides the
solutions.
"""
EXPECTED_RESULTS = (
    "results of a vehicle that depend on this vehicle alone: nothing kept in a class, a module or the model itself "
    "from one call or setting to another, no mean or sum over the batch, nothing random"
)
_passed_checks: set[str] = set()
"""Identity of the studies whose code has passed in this process, in case the cache folder is not writable."""


def choose_batch_size(study: Study, selection: Selection = EVERYTHING) -> tuple[int, bool]:
    """Choose the most economical number of settings in a batch; also returns whether a recorded scene can replace
    SUMO.
    """
    system = selection.of(assemble(study, study.source))
    return settings_per_batch(system, Engine.RECORDED), is_recorded(system)


def evaluate_all(
    study: Study,
    settings: FloatArray,
    pool: Pool,
    done: Callable[[int], None] = lambda number: None,
    verified: int = VERIFIED_SETTINGS,
    selection: Selection = EVERYTHING,
    inputs: Inputs | None = None,
) -> Evaluations:
    """Evaluate M filtered settings of n characteristics, shape (M, n); equal settings are simulated once.

    User code is checked first (`check_code`). A sample of the settings in a recorded scene is also simulated in SUMO,
    until `verified` ones of the study have been.
    `done` is called with the number of settings of every finished batch. Of a `selection`, nothing is verified in SUMO;
    a caller that evaluates many times may keep the `inputs` (`inputs_of`).
    """
    retrying_pool, inputs = RetryingPool(pool, study), inputs_of(study, pool) if inputs is None else inputs
    work = pack_study(study, inputs, selection=selection)
    check_code(study, inputs, retrying_pool)
    distinct_settings, row_of = np.unique(settings, axis=0, return_inverse=True)
    if work not in _batch_sizes:
        _batch_sizes[work] = choose_batch_size(study, selection)
    best_size, is_recorded = _batch_sizes[work]
    share = len(distinct_settings) / (BATCHES_PER_CALL_AND_WORKER * pool.workers)
    size = min(best_size, math.ceil(max(share, SMALLEST_BATCH * best_size)))
    starts = range(0, len(distinct_settings), size)
    futures = {retrying_pool.submit(work, distinct_settings[start : start + size]): start for start in starts}
    sample_size = max(min(verified - _verified_counts.get(work, 0), len(distinct_settings)), 0)
    sample = np.linspace(0, len(distinct_settings) - 1, sample_size).astype(int)
    sumo_future = recorded_future = None
    if is_recorded and len(sample) and selection == EVERYTHING:
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
        refuse_unlike_sumo(study, expected, wait_for_result(sumo_future))
        _verified_counts[work] = _verified_counts.get(work, 0) + len(sample)
    return evaluations.take(row_of.ravel())


def ask_why_no_verdict(study: Study, pool: Pool) -> str:
    """Why simulations of a study tell nothing about its ADS, as `why_no_verdict` finds in a worker; "" if they do."""
    work = pack_study(study, inputs_of(study, pool), empty_road=True)
    result = RetryingPool(pool, study).evaluate_original(work, must_succeed=False)
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
        # Without an entry, a file that does not exist: its digest differs.
        files_read = _files_read.get(key, {"": "never read"})
        if any(digest_of(file_by_name(name, study.origin.places)) != digest for name, digest in files_read.items()):
            _files_read[key] = dict(RetryingPool(pool, study).evaluate_original(work).files)
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


def check_code(study: Study, inputs: Inputs, pool: RetryingPool) -> None:
    """Check the user code of a study in a worker, unless it has passed before with the same files.

    Raises
    ------
    UserCodeError
        With file, line and advice of the first finding that makes results wrong.
    """
    if not (user_code_names(study) or any(":" in name for name in study.search.algorithms)):
        return
    identity = json.dumps([tables_of(study), inputs, RESULTS, version("safevar_sumo")], sort_keys=True, default=str)
    name = hashlib.sha256(identity.encode()).hexdigest()
    marker = platformdirs.user_cache_path("safevar_sumo") / "checks" / name
    if name in _passed_checks or marker.exists():
        return
    pool.evaluate_original(pack_study(study, inputs, check=True))
    _passed_checks.add(name)
    with suppress(OSError):  # without the marker, the next process checks again
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()


def refuse_difference(study: Study, run: str, in_run: Evaluations, isolated: Evaluations, command: str) -> None:
    """Refuse a setting whose evaluation in a run differs from its isolated evaluation, which `command` reproduces.

    Raises
    ------
    UserCodeError
        With the models, the first result that differs, and the contract.
    """
    if in_run.failed[0] or isolated.failed[0]:
        return
    for _, difference in differences(isolated.results, in_run.results):
        problem = (
            f"with {' and '.join(user_code_names(study))} a result depends on what else is simulated: "
            f"{difference} in run {run}; to reproduce it: {command}"
        )
        raise UserCodeError(f"study {study.name!r}", problem, EXPECTED_RESULTS)


def works_for_sumo(study: Study, inputs: Inputs) -> tuple[bytes, bytes]:
    """The packed study with which SUMO verifies results, and a packed study with comparable results from recorded
    scenes.

    SUMO repeats only a few cells of a rating; the second study then has the same cells. Otherwise it is empty.
    """
    sumo_study = study_for_sumo_check(study, assemble(study).weather)
    if sumo_study is study:
        return pack_study(study, inputs, engine=Engine.LIBSUMO), b""
    inputs = {**inputs, "network": network_digests(assemble(sumo_study))}
    return pack_study(sumo_study, inputs, engine=Engine.LIBSUMO), pack_study(sumo_study, inputs)


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO; skip settings that SUMO could not
    simulate.

    Raises
    ------
    InputError
        With the first such setting and both values.
    """
    both = ~(recorded.failed | in_sumo.failed)
    if not both.any():
        return  # evaluations that have failed lack the user's metrics
    recorded, in_sumo = recorded.take(both), in_sumo.take(both)
    for row, difference in differences(in_sumo.results, recorded.results, ROUNDING):
        pairs = zip(study.vehicle.characteristics, recorded.settings[row], strict=True)
        values = ", ".join(f"{name} = {value:.17g}" for name, value in pairs)
        raise InputError(
            f"study {study.name!r}",
            f"{difference} in the recorded scene and in SUMO with {values}",
            "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or `engine=sumo`",
        )
