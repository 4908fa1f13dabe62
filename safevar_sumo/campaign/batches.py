"""Evaluation of many settings by a pool, in batches, for questions; and checks of results against SUMO."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np

from safevar_sumo.campaign.evaluation import EVERYTHING, VERIFIED_SETTINGS, Inputs, Selection, Task, network_digests
from safevar_sumo.campaign.identity import check_code, inputs_of
from safevar_sumo.campaign.pool import Batch, Pool, evaluate_batches
from safevar_sumo.errors import InputError
from safevar_sumo.protocol.rater import study_for_sumo_check
from safevar_sumo.records import ROUNDING, Evaluations, FloatArray, differences
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine, assemble, is_recorded, settings_per_batch

BATCHES_PER_WORKER = 4
"""Largest number of batches per worker: with several, no worker waits long for another, and the time left is known."""
ECONOMICAL_SHARE = 1 / 4
"""Size of a batch, as a share of the most economical one, from which the steps of a simulation cost no more than its
vehicles: smaller batches are one for each worker.
"""
_batch_sizes: dict[bytes, tuple[int, bool]] = {}
"""Results of `choose_batch_size`, by packed study."""
_verified_counts: dict[bytes, int] = {}
"""Number of settings with verified results, by packed study."""


def choose_batch_size(study: Study, selection: Selection) -> tuple[int, bool]:
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
    inputs = inputs_of(study, pool) if inputs is None else inputs
    work = Task(study=study, inputs=inputs, selection=selection).packed
    check_code(study, inputs, pool)
    distinct_settings, row_of = np.unique(settings, axis=0, return_inverse=True)
    if work not in _batch_sizes:
        _batch_sizes[work] = choose_batch_size(study, selection)
    best_size, is_recorded = _batch_sizes[work]
    share = len(distinct_settings) / pool.workers
    size = math.ceil(min(best_size, max(share / BATCHES_PER_WORKER, min(share, ECONOMICAL_SHARE * best_size))))
    batches = [Batch(work, distinct_settings[start : start + size]) for start in range(0, len(distinct_settings), size)]
    sample_size = max(min(verified - _verified_counts.get(work, 0), len(distinct_settings)), 0)
    sample = np.linspace(0, len(distinct_settings) - 1, sample_size).astype(int)
    must_verify = is_recorded and len(sample) > 0 and selection == EVERYTHING
    works = filter(None, works_for_sumo(study, inputs)) if must_verify else ()
    verifications = [Batch(sumo_work, distinct_settings[sample]) for sumo_work in works]

    def show_done(number: int, size: int) -> None:
        if number < len(batches):
            done(size)

    results = evaluate_batches([*batches, *verifications], pool, show_done)
    evaluations = Evaluations.concatenate(results[: len(batches)])
    if must_verify:
        in_sumo, *recorded = results[len(batches) :]
        refuse_unlike_sumo(study, recorded[0] if recorded else evaluations.take(sample), in_sumo)
        _verified_counts[work] = _verified_counts.get(work, 0) + len(sample)
    return evaluations.take(row_of.ravel())


def works_for_sumo(study: Study, inputs: Inputs) -> tuple[bytes, bytes]:
    """The packed study with which SUMO verifies results, and a packed study with comparable results from recorded
    scenes.

    SUMO repeats only a few cells of a rating; the second study then has the same cells. Otherwise it is empty.
    """
    sumo_study = study_for_sumo_check(study, assemble(study).weather)
    if sumo_study is study:
        return Task(study=study, inputs=inputs, engine=Engine.LIBSUMO).packed, b""
    inputs = {**inputs, "network": network_digests(assemble(sumo_study))}
    recorded = Task(study=sumo_study, inputs=inputs)
    return msgspec.structs.replace(recorded, engine=Engine.LIBSUMO).packed, recorded.packed


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
