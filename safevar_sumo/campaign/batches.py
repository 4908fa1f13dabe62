"""Work for the processes of a pool: evaluate many settings for a question, check user code, and
find out whether simulations of a study say anything about its ADS.
"""

from __future__ import annotations

import hashlib
import logging
import math
import platform
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.ads import PerVehicleAds
from safevar_sumo.campaign.cache import (
    cache_of,
    content_of,
    evaluations_in,
    key_of_settings,
    package_digest,
)
from safevar_sumo.campaign.evaluation import (
    EVERYTHING,
    VERIFIED_SETTINGS,
    Selection,
    Task,
    carry_out,
    evaluate_settings,
    home_of,
    repeat_first_batch,
    system_of,
    verify_settings,
)
from safevar_sumo.campaign.inputs import files_of, manifest_now, refuse_changed_inputs
from safevar_sumo.campaign.pool import Pool, Spare
from safevar_sumo.campaign.share import MAX_SKIPPED
from safevar_sumo.campaign.user_checks import check_code
from safevar_sumo.errors import InputError, UserCodeError, warn
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, differences
from safevar_sumo.study import Study, user_code_names
from safevar_sumo.sumo import efficient_batch, reason_against_scenes
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.terminal import Progress
from safevar_sumo.vehicles import VEHICLES, Vehicle

BATCHES_PER_WORKER = 4
"""Largest number of batches for each worker. With several batches, no worker waits long for the
last worker, and progress can estimate the time left.
"""
MAX_REPEATS = 5
"""Largest number of simulations that are repeated as a check, if simulations are limited."""
LOGGER = logging.getLogger(__name__)
FEW_SKIPPED = 100
"""The share of skipped settings is computed as if a question had at least this number of settings.
Otherwise a single failure among the first settings would end the question.
"""
PORTION = 4096
"""Number of settings whose results are kept together, in one entry of the cache."""
SMALL_PORTION = 256
"""The same number if vehicles drive one after another, or in SUMO itself. Simulations then take
long, and an interruption should lose only a few of them.
"""
COMPILING = "compiling the vehicle model, for the first time"
"""The phase of progress during which a worker compiles the vehicle model."""
ECONOMICAL_FRACTION = 1 / 4
"""A batch of at least this fraction of the most economical size is economical: a step of a smaller
batch costs as much as a step of this batch. Therefore few settings make one batch instead of two.
If vehicles drive one after another, few settings make one batch for each worker instead.
"""


def refuse_other_worker(study: Study, manifest: JsonObject, package: str) -> None:
    """Refuse a worker of a cluster that has other versions of libraries, other files of the study,
    or other code of this package.
    """
    refuse_changed_inputs(study, system_of(study), manifest)
    if package != package_digest():
        raise InputError(
            "cluster",
            f"a worker on {platform.node()} has other code of safevar_sumo, or another Python",
            "the same installation everywhere",
        )


def _refuse_other_workers(study: Study, used: Iterable[str], pool: Pool) -> None:
    if pool.on_cluster is not None:
        manifest = manifest_now(study, system_of(study), used)
        pool.on_cluster(refuse_other_worker, study, manifest, package_digest())


def spare(limit: int, minimum: int) -> Spare:
    """Split the simulations that are not needed for an answer. `limit` is the number of allowed
    simulations, `minimum` the least number for an answer.
    """
    # Each check takes at most a tenth, so that most simulations are left for the answer.
    share = limit // 10
    check = min(share, max(limit - minimum, 0))
    repetition = min(share, MAX_REPEATS, max(limit - minimum - check, 0))
    return Spare(check, repetition)


def evaluate_all(
    study: Study,
    settings: FloatArray,
    pool: Pool,
    finish: Callable[[int], None] = lambda size: None,
    verified: int = VERIFIED_SETTINGS,
    selection: Selection = EVERYTHING,
    begin: Callable[[], None] = lambda: None,
) -> Evaluations:
    """Evaluate M filtered settings of n characteristics, shape (M, n). Equal settings are simulated
    once. Settings are not simulated if another question of a page or the cache has their results.

    First `check_code` checks user code. `begin` is called before the first simulation, and `finish`
    with the number of settings of each finished batch. Recorded scenes are verified: a sample of
    the settings is simulated again in SUMO, until `verified` settings of the study are verified.
    Nothing is verified if a `selection` restricts or varies the study.
    """
    if pool.shared is None:
        return _evaluate_unshared(
            study, settings, pool, finish, verified, selection, begin
        )
    evaluation_of = pool.shared.setdefault(
        msgspec.msgpack.encode((study, selection)), {}
    )
    rows = np.unique(settings, axis=0)
    new_rows = rows[[row.tobytes() not in evaluation_of for row in rows]]
    finish(len(rows) - len(new_rows))
    if len(new_rows):
        evaluations = _evaluate_unshared(
            study, new_rows, pool, finish, verified, selection, begin
        )
        for number, row in enumerate(new_rows):
            evaluation_of[row.tobytes()] = evaluations.take([number])
    return Evaluations.concatenate([evaluation_of[row.tobytes()] for row in settings])


def _evaluate_unshared(
    study: Study,
    settings: FloatArray,
    pool: Pool,
    finish: Callable[[int], None],
    verified: int,
    selection: Selection,
    begin: Callable[[], None],
) -> Evaluations:
    """Evaluate settings like `evaluate_all`, but without the results that other questions of the
    page have.
    """
    packed_study = msgspec.msgpack.encode(study)
    opened = opened_by(study, pool)
    system = system_of(study)
    if packed_study not in pool.inputs:
        pool.inputs[packed_study] = manifest_now(study, system, opened)
        _refuse_other_workers(study, opened, pool)

    # Each portion has its own entry in the cache, so that an interruption loses one portion at
    # most.
    distinct_settings, row_of = np.unique(settings, axis=0, return_inverse=True)
    batches = choose_batches(study, selection)
    cache = cache_of(study, opened)
    evaluated = []
    portions = 1
    if cache:
        portions = math.ceil(len(distinct_settings) / batches.portion)
    for portion in np.array_split(distinct_settings, portions):
        key = b""
        if cache:
            key = key_of_settings(cache.key_of(study, opened), selection, portion)
            cached = evaluations_in(cache.get(key))
            if cached:
                evaluated.append(cached)
                finish(len(portion))
                continue
        begin()
        sample_size = verified - pool.verified[packed_study]
        task = Task(study=study, batch_size=batches.best, selection=selection)
        evaluations = _simulate(task, portion, pool, batches, finish, sample_size)
        inputs = pool.inputs[packed_study]
        if files_of(study, system, inputs["files"]) != inputs["files"]:
            refuse_changed_inputs(study, system, inputs)
        pool.verified[packed_study] += max(min(sample_size, len(portion)), 0)
        if cache and not evaluations.failed.any():
            cache.put(key, content_of(evaluations), len(portion))
        evaluated.append(evaluations)
        LOGGER.debug("%s: %d settings simulated", study.name, len(portion))
        _log_failures(study, evaluations)
    evaluations = Evaluations.concatenate(evaluated)
    if study.search.failed == "skip":
        _refuse_many_failures(study, evaluations, pool)
    return evaluations.take(row_of.ravel())


def _log_failures(study: Study, evaluations: Evaluations) -> None:
    """Log how many settings could not be simulated, with the reason of the first."""
    failures = evaluations.take(evaluations.failed)
    if len(failures):
        LOGGER.warning(
            "%s: %d of %d settings could not be simulated: %s",
            study.name,
            len(failures),
            len(evaluations),
            failures.reason(0),
        )


def _refuse_many_failures(study: Study, evaluations: Evaluations, pool: Pool) -> None:
    """Count simulated and failed settings of a study that skips failures, and refuse a simulator
    that fails too often.
    """
    pool.simulated += len(evaluations)
    pool.failed += int(evaluations.failed.sum())
    if pool.failed <= MAX_SKIPPED * max(pool.simulated, FEW_SKIPPED):
        return
    failures = evaluations.take(evaluations.failed)
    numbers = f"{pool.failed} of {pool.simulated} settings failed, more than 10 %"
    problem = f"search.failed = 'skip': {numbers}"
    if len(failures):
        problem += f": {failures.reason(0)}"
    raise UserCodeError(study.source, problem, "a simulator that fails less often")


def forget_other(study: Study, pool: Pool, original: Evaluations) -> None:
    """Forget the results of an interrupted command if the simulator has changed. `original` is a
    new simulation of the original vehicle: if its result differs from the kept result, nothing is
    kept.
    """
    opened = opened_by(study, pool)
    cache = cache_of(study, opened)
    if cache:
        key = hashlib.sha256(b"original" + cache.key_of(study, opened)).digest()
        cached = evaluations_in(cache.get(key))
        if cached is not None and list(differences(cached.results, original.results)):
            warn(
                "does not continue: the simulator drives the original vehicle otherwise now"
            )
            cache.forget()
        cache.put(key, content_of(original))


def repeat_first_batches(study: Study, pool: Pool) -> None:
    """Let each worker simulate its first batch of a study with user code again. Results that differ
    raise the error of `repeat_first_batch`.
    """
    if user_code_names(study):
        limit = None
        if pool.spare is not None:
            limit = pool.spare.repetition // simulations_of_setting(system_of(study))
        pool.everywhere(repeat_first_batch, study, home=home_of(study), limit=limit)


def opened_by(study: Study, pool: Pool) -> list[str]:
    """The names of the files that the user code of a study opens. The first call checks the code.
    Other variants of the study with the same code are not checked again in this pool.
    """
    names = frozenset(user_code_names(study))
    places = (study.name, *study.origin.places)
    for (checked_names, folders), opened in pool.opened.items():
        if names <= checked_names and folders == places:
            return opened
    _refuse_other_workers(study, [], pool)
    opened = check_code(study, pool)
    pool.opened[names, places] = opened
    return opened


def _simulate(
    task: Task,
    settings: FloatArray,
    pool: Pool,
    batches: Batches,
    finish: Callable[[int], None],
    sample_size: int,
) -> Evaluations:
    """Simulate distinct settings, shape (k, n), in batches. If recorded scenes replace SUMO,
    simulate a sample of `sample_size` settings again in SUMO.
    """
    parts = np.array_split(settings, batches.number(len(settings), pool))
    jobs = [(task, part) for part in parts]

    def show_ended(ended: Sequence[int]) -> None:
        for number in ended:
            finish(len(parts[number]))

    evaluations = Evaluations.concatenate(
        carry_out(evaluate_settings, jobs, pool, show_ended)
    )
    sample_size = min(sample_size, len(settings))
    if batches.are_recorded and sample_size > 0 and task.selection == EVERYTHING:
        sample = np.linspace(0, len(settings) - 1, sample_size).astype(int)
        sample = sample[~evaluations.failed[sample]]
        carry_out(
            verify_settings,
            [(task, settings[sample], evaluations.points[sample])],
            pool,
        )
    return evaluations


class Batches(NamedTuple):
    """The sizes of batches for the settings of a study.

    Attributes
    ----------
    best
        The most economical number of settings in a batch.
    share_steps
        Whether the vehicles of a batch take each step together. A small batch then costs as much as
        a larger batch.
    are_recorded
        Whether a recorded scene replaces SUMO.
    """

    best: int
    share_steps: bool
    are_recorded: bool

    @property
    def portion(self) -> int:
        """The number of settings that are simulated before their results are kept."""
        if self.share_steps:
            return PORTION
        return SMALL_PORTION

    def number(self, settings: int, pool: Pool) -> int:
        """The number of batches into which a number of settings is divided."""
        per_worker = settings / pool.workers
        economical = ECONOMICAL_FRACTION * self.best
        if not self.share_steps:
            economical = min(per_worker, economical)
        size = min(self.best, max(per_worker / BATCHES_PER_WORKER, economical))
        return max(math.ceil(settings / math.ceil(size)), 1)


def choose_batches(study: Study, selection: Selection) -> Batches:
    """Choose the sizes of batches for the settings of a study."""
    system = selection.of(system_of(study))
    are_recorded = not reason_against_scenes(system)
    have_turns = (
        isinstance(system.ads, PerVehicleAds) or system.ads.max_vehicles is not None
    )
    return Batches(
        efficient_batch(system), are_recorded and not have_turns, are_recorded
    )


def compile_vehicle(study: Study, pool: Pool, progress: Progress) -> None:
    """Let one worker compile the code of a study's vehicle model, and show this phase of progress.
    The other workers then load the compiled code. Nothing happens if the code is already compiled.
    """
    if study.vehicle.model in pool.compiled:
        return
    pool.compiled.add(study.vehicle.model)
    shipped = VEHICLES.get(study.vehicle.model)
    # Most vehicles compile nothing: no worker has to start only to say so.
    if shipped is not None and shipped.compile is Vehicle.compile:
        return
    task = Task(study=study)
    if not carry_out(_compile_vehicle, [(task, True)], pool)[0]:
        progress(COMPILING, 0, 1)
        carry_out(_compile_vehicle, [(task, False)], pool)


def _compile_vehicle(task: Task, only_load: bool) -> bool:
    system = system_of(task.study)
    with system.modules.active():
        return bool(system.vehicle.compile(only_load=only_load))


def ask_why_no_verdict(
    study: Study, pool: Pool, begin: Callable[[], None] = lambda: None
) -> str:
    """The reason why simulations of a study say nothing about its ADS; "" if simulations do say
    something. A worker finds the reason with `why_no_verdict`. `begin` is called before a
    simulation.
    """
    opened = opened_by(study, pool)
    cache = cache_of(study, opened)
    key = b""
    if cache:
        key = hashlib.sha256(b"no verdict" + cache.key_of(study, opened)).digest()
        content = cache.get(key)
        if content is not None:
            return content.decode()
    begin()
    reason = str(carry_out(_why_no_verdict, [(Task(study=study),)], pool)[0])
    if cache:
        cache.put(key, reason.encode())
    return reason


def _why_no_verdict(task: Task) -> str:
    return why_no_verdict(system_of(task.study))
