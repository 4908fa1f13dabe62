"""What a pool computes for a study besides its runs: many settings for a question, in batches; whether simulations tell
anything about the ADS; and the check of user code.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version

import numpy as np
import platformdirs

from safevar_sumo.campaign.evaluation import (
    EVERYTHING,
    VERIFIED_SETTINGS,
    Selection,
    Task,
    refuse_unlike_sumo,
    tasks_for_sumo,
)
from safevar_sumo.campaign.identity import files_of
from safevar_sumo.campaign.pool import Batch, Pool, evaluate_batches, evaluate_original
from safevar_sumo.plugins import Files
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import RESULTS
from safevar_sumo.study import Study, tables_of, user_code_names
from safevar_sumo.sumo import Engine, assemble, is_recorded, settings_per_batch

BATCHES_PER_WORKER = 4
"""Largest number of batches per worker: with several, no worker waits long for another, and the time left is known."""
ECONOMICAL_FRACTION = 1 / 4
"""Fraction of the most economical batch size from which on the steps of a simulation cost no more than its vehicles.
Settings that fill only smaller batches make one batch for each worker.
"""
_batch_sizes: dict[bytes, tuple[int, bool]] = {}
"""Results of `choose_batch_size`, by packed task."""
_verified_counts: dict[bytes, int] = {}
"""Number of settings with verified results, by packed task."""
_passed_checks: set[str] = set()
"""Identity of the studies whose code has passed in this process, in case the cache folder is not writable."""


def evaluate_all(
    study: Study,
    settings: FloatArray,
    pool: Pool,
    done: Callable[[int], None] = lambda size: None,
    verified: int = VERIFIED_SETTINGS,
    selection: Selection = EVERYTHING,
    files: Files | None = None,
) -> Evaluations:
    """Evaluate M filtered settings of n characteristics, shape (M, n); equal settings are simulated once.

    User code is checked first (`check_code`). A sample of the settings in a recorded scene is also simulated in SUMO,
    until `verified` ones of the study have been.
    `done` is called with the number of settings of every finished batch. Of a `selection`, nothing is verified in SUMO;
    a caller that evaluates many times may keep the `files` (`files_of`).
    """
    files = files_of(study) if files is None else files
    packed_task = Task(study=study, files=files, selection=selection).packed
    check_code(study, files, pool)
    distinct_settings, row_of = np.unique(settings, axis=0, return_inverse=True)
    if packed_task not in _batch_sizes:
        _batch_sizes[packed_task] = choose_batch_size(study, selection)
    best_size, has_recorded_scene = _batch_sizes[packed_task]
    per_worker = len(distinct_settings) / pool.workers
    size = math.ceil(
        min(best_size, max(per_worker / BATCHES_PER_WORKER, min(per_worker, ECONOMICAL_FRACTION * best_size)))
    )
    starts = range(0, len(distinct_settings), size)
    batches = [Batch(packed_task, distinct_settings[start : start + size]) for start in starts]
    sample_size = max(min(verified - _verified_counts.get(packed_task, 0), len(distinct_settings)), 0)
    sample = np.linspace(0, len(distinct_settings) - 1, sample_size).astype(int)
    must_verify = has_recorded_scene and sample_size > 0 and selection == EVERYTHING
    verifying_tasks = filter(None, tasks_for_sumo(study, files)) if must_verify else ()
    verifications = [Batch(verifying_task, distinct_settings[sample]) for verifying_task in verifying_tasks]

    def show_done(number: int, size: int) -> None:
        if number < len(batches):
            done(size)

    results = evaluate_batches([*batches, *verifications], pool, show_done)
    evaluations = Evaluations.concatenate(results[: len(batches)])
    if must_verify:
        in_sumo, *recorded = results[len(batches) :]
        refuse_unlike_sumo(study, recorded[0] if recorded else evaluations.take(sample), in_sumo)
        _verified_counts[packed_task] = _verified_counts.get(packed_task, 0) + sample_size
    return evaluations.take(row_of.ravel())


def choose_batch_size(study: Study, selection: Selection) -> tuple[int, bool]:
    """Choose the most economical number of settings in a batch; also returns whether a recorded scene can replace
    SUMO.
    """
    system = selection.of(assemble(study, study.source))
    return settings_per_batch(system, Engine.RECORDED), is_recorded(system)


def ask_why_no_verdict(study: Study, pool: Pool) -> str:
    """Why simulations of a study tell nothing about its ADS, as `why_no_verdict` finds in a worker; "" if they do."""
    packed_task = Task(study=study, files=files_of(study), purpose="empty road").packed
    result = evaluate_original(study, packed_task, pool, must_succeed=False)
    return "" if len(result) else next(iter(result.reasons.values()), "")  # a failed simulation has a row


def check_code(study: Study, files: Files, pool: Pool) -> None:
    """Check the user code of a study in a worker, unless it has passed before with the same files.

    Raises
    ------
    UserCodeError
        With file, line and advice of the first finding that makes results wrong.
    """
    if not user_code_names(study):
        return
    identity = json.dumps([tables_of(study), files, RESULTS, version("safevar_sumo")], sort_keys=True, default=str)
    digest = hashlib.sha256(identity.encode()).hexdigest()
    marker = platformdirs.user_cache_path("safevar_sumo") / "checks" / digest
    if digest in _passed_checks or marker.exists():
        return
    evaluate_original(study, Task(study=study, files=files, purpose="check").packed, pool)
    _passed_checks.add(digest)
    with suppress(OSError):  # without the marker, the next process checks again
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
