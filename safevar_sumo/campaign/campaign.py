"""A campaign carries out the runs of a study: shares of the runs go to the workers of a pool."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.random import default_rng

from safevar_sumo.campaign.batches import ask_why_no_verdict, compile_vehicle
from safevar_sumo.campaign.evaluation import (
    Task,
    carry_out,
    evaluate_settings,
    verify_settings,
)
from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.campaign.pool import Look, Pool
from safevar_sumo.campaign.runs import (
    MAX_REPEATED,
    RunKey,
    RunResult,
    algorithm_of,
    all_runs,
)
from safevar_sumo.campaign.share import Share, carry_share
from safevar_sumo.campaign.user_checks import check_code, repeat_elsewhere
from safevar_sumo.errors import InputError, SimulationError, one_of, warn
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.results import (
    MANIFEST,
    JournalReader,
    ResultsDirectory,
    journal_file,
    read_manifest,
)
from safevar_sumo.study import Study
from safevar_sumo.sumo import efficient_batch, reason_against_scenes
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import Parts, Progress

LOGGER = logging.getLogger(__name__)
BATCHES_PER_SHARE = 2
"""Largest number of batches that the populations of all runs of a share fill."""
MAX_RUNS = 256
"""Largest number of runs in a share. Each run keeps a file open."""
UNSAFE_REPEATED = 150
"""Largest number of unsafe solutions that SUMO simulates again after a search in recorded
scenes.
"""
SUMO_COST = 60
"""Number of simulations in recorded scenes that take as long as a simulation in SUMO, roughly."""
SETTINGS_PER_JOB = 150
"""Largest number of settings that a worker simulates again in SUMO in one job."""
RECORDED = "recorded"
SUMO = "sumo"
ENGINES = RECORDED, SUMO
"""The engines that a command may name."""


def run_campaign(
    study: Study,
    system: System,
    keys: Sequence[RunKey],
    directory: Path,
    pool: Pool,
    progress: Progress,
    engine: str = RECORDED,
    *,
    retry_failed: bool = False,
) -> None:
    """Carry out runs of a study, or resume unfinished runs. If the runs are all runs of the study,
    write its solutions.

    Parameters
    ----------
    directory
        The directory of the results.
    engine
        The engine that moves the vehicles. A sample of the results from recorded scenes is
        simulated again in SUMO at the end.
    retry_failed
        Whether to simulate settings again that failed before.

    Raises
    ------
    SafevarError
        If a journal cannot be written, another process works on a run, or the study has a mistake.
    """
    pool.spare = None
    opened = check_code(study, pool)
    is_new = not (directory / MANIFEST).exists()
    read: Iterable[str] = ()
    if not system.mover.is_exact:
        read = opened if is_new else read_manifest(directory).get("files", ())
    results = ResultsDirectory(
        directory,
        study,
        manifest_now(study, system, read),
        system.measuring.scoring,
        [str(key) for key in keys],
    )
    for remark in results.extent_remarks({str(key) for key in all_runs(study)}):
        warn(remark)
    system, engine_used, reason = choose_engine(system, engine)
    results.manifest["engine"] = {"name": engine_used, "reason": reason}
    results.manifest |= _about_algorithms(study)
    # A batch may hold settings of several runs. Its size changes no result.
    task = Task(study=study, in_sumo=system.in_sumo, batch_size=efficient_batch(system))

    evaluations = len(keys) * study.search.evaluations
    repeated = 0
    if engine_used == RECORDED:
        repeated = min(evaluations, MAX_REPEATED)
    parts = Parts(progress, [evaluations, SUMO_COST * repeated])
    show_search = parts.begin()
    show_journals = journal_progress(study, keys, directory, show_search)
    show_journals([])
    compile_vehicle(study, pool, show_search)
    no_verdict = ask_why_no_verdict(study, pool)
    original = evaluate_original(task, pool)
    undeclared = [name for name in opened if name not in results.manifest["files"]]
    for remark in _remarks(undeclared, no_verdict, original):
        warn(f"study {study.name!r}: {remark}")
    results.begin(original)
    if is_new and not system.mover.is_exact and system.repeats == 1:
        repeat_elsewhere(study, pool)

    LOGGER.info(
        "%s: search of %d runs with %d workers into %s",
        study.name,
        len(keys),
        pool.workers,
        directory,
    )
    begin = time.monotonic()
    hands = deal(keys, pool.workers, task.batch_size, study.search.population)
    place = directory.absolute()
    shares = [
        (task, Share(dealt, place, results.manifest, original, retry_failed))
        for dealt in hands
    ]
    runs = list(
        chain.from_iterable(carry_out(carry_share, shares, pool, show_journals))
    )

    LOGGER.info("%s: searched in %.1f s", study.name, time.monotonic() - begin)
    # Solutions of a part of the runs would look like the solutions of the whole study.
    runs.sort(key=lambda run: run.key)
    for remark in _remarks_on_discarded(study, runs):
        warn(remark)
    if [run.key for run in runs] == sorted(all_runs(study)):
        results.finish({run.key: run.solutions for run in runs})
    if engine_used == RECORDED and runs:
        sample = choose_sample(study, original, runs)
        begin = time.monotonic()
        for remark in repeat_in_sumo(task, sample, pool, parts.begin()):
            warn(remark)
        seconds = time.monotonic() - begin
        LOGGER.info("%s: sample repeated in SUMO in %.1f s", study.name, seconds)


def _remarks_on_discarded(study: Study, runs: Sequence[RunResult]) -> Iterator[str]:
    """Remarks on returned settings that are no solutions."""
    for algorithm in study.search.labels:
        count = sum(run.discarded for run in runs if run.key.algorithm == algorithm)
        if count:
            yield (
                f"study {study.name!r}: {count} settings that {algorithm} returned are no"
                " solutions: the original vehicle is not safe in their encounter, or an objective"
                " is undefined (problem.scoring.valid says which)"
            )


def _remarks(
    undeclared: Sequence[str], no_verdict: str, original: Evaluations
) -> Iterator[str]:
    """Remarks on what makes results uncertain or useless: files that user code reads and the study
    does not name, a driving system that fails on an empty road, and an original vehicle that
    collides.
    """
    if undeclared:
        files = ", ".join(undeclared)
        yield f"user code reads {files}, which no `files` of the study names: edits go unnoticed"
    if no_verdict:
        yield no_verdict
    if original.collided[0]:
        words = Unsafe().breach_in_words(original)
        yield f"the original vehicle itself {words}: no change is needed"


def _about_algorithms(study: Study) -> JsonObject:
    """The entries of a manifest on the study's algorithms: titles, and algorithms that stop by
    themselves.
    """
    titles = {}
    stopping = []
    for name in study.search.labels:
        algorithm = algorithm_of(name, study)
        if algorithm.title:
            titles[name] = algorithm.title
        if algorithm.stops_by_itself:
            stopping.append(name)
    return {"titles": titles, "stop_by_themselves": stopping}


def evaluate_original(task: Task, pool: Pool) -> Evaluations:
    """Evaluate the original vehicle. Raise an error if the original vehicle cannot be simulated, or
    gives no valid test: a search then has nothing to compare with.
    """
    settings = np.array([[row.original for row in task.study.domains.values()]])
    original: Evaluations = carry_out(evaluate_settings, [(task, settings)], pool)[0]
    if original.failed[0]:
        raise SimulationError(
            f"study {task.study.name!r}: the original vehicle cannot be simulated:"
            f" {original.reason(0)}"
        )
    if not original.valid[0]:
        raise InputError(
            task.study.source,
            "the original vehicle violates a test's speed tolerance before the ADS acts"
            " (invalid-test), so there is no baseline",
            "tests whose speed the vehicle can hold",
        )
    return original


def deal(
    keys: Sequence[RunKey], workers: int, batch_size: int, population: int
) -> list[Sequence[RunKey]]:
    """Divide runs into shares. The number of shares is a multiple of the number of workers, unless
    the runs are too few.

    All runs of a share are carried out at the same time. Together they fill large batches, in which
    a setting costs least.
    """
    runs_at_once = min(math.ceil(BATCHES_PER_SHARE * batch_size / population), MAX_RUNS)
    count = min(workers * math.ceil(len(keys) / (workers * runs_at_once)), len(keys))
    # Every `count`-th run goes to the same share, so that each share has runs of all algorithms.
    return [keys[number::count] for number in range(count)]


def choose_sample(
    study: Study, original: Evaluations, runs: Sequence[RunResult]
) -> Evaluations:
    """Choose the evaluations of a search that SUMO simulates again: at most `UNSAFE_REPEATED`
    unsafe solutions, then other evaluations that the study's seed draws.
    """
    solutions = Evaluations.concatenate([run.solutions for run in runs])
    criterion = Unsafe.default(original.first_metrics, solutions.outcome)
    rows = np.flatnonzero(criterion.of(solutions))
    rows = rows[np.unique(solutions.settings[rows], axis=0, return_index=True)[1]]

    rng = default_rng(study.search.seed)
    samples = Evaluations.concatenate([run.sample for run in runs])
    samples = samples.take(rng.permutation(len(samples)))
    unsafe = solutions.take(rng.permutation(rows)[:UNSAFE_REPEATED])
    candidates = Evaluations.concatenate([unsafe, samples])
    distinct = np.unique(candidates.settings, axis=0, return_index=True)[1]
    return candidates.take(np.sort(distinct)[:MAX_REPEATED])


def repeat_in_sumo(
    task: Task, sample: Evaluations, pool: Pool, progress: Progress
) -> set[str]:
    """Simulate evaluations again in SUMO. Return remarks on settings that could not be simulated.
    If results differ, the error of `verify_in_sumo` is raised.
    """
    phase = f"{task.study.name}: verifying in SUMO"
    batches = np.array_split(
        np.arange(len(sample)), math.ceil(len(sample) / SETTINGS_PER_JOB) or 1
    )
    jobs = [(task, sample.settings[rows], sample.points[rows]) for rows in batches]
    verified = 0

    def show(ended: Sequence[int]) -> None:
        nonlocal verified
        verified += sum(len(batches[number]) for number in ended)
        progress(phase, verified, len(sample))

    show([])
    remarks = carry_out(verify_settings, jobs, pool, show)
    return {remark for remark in remarks if remark}


def journal_progress(
    study: Study, keys: Sequence[RunKey], directory: Path, progress: Progress
) -> Look:
    """Make a function that shows how many evaluations the runs have asked for, as their journals
    say. The total includes all evaluations that unfinished runs may still ask for.
    """
    readers = [
        JournalReader(journal_file(directory, str(key)), study.search.evaluations)
        for key in keys
    ]

    def show(ended: Sequence[int]) -> None:
        evaluations = 0
        remaining = 0
        finished = 0
        for reader in readers:
            evaluations += reader.asked()
            remaining += reader.left
            finished += reader.is_finished
        total = evaluations + remaining
        progress(f"{study.name}: {finished} of {len(keys)} runs", evaluations, total)

    return show


def choose_engine(system: System, name: str) -> tuple[System, str, str]:
    """Choose the engine that moves a system's vehicles. Return the system with this engine, the
    engine's name, and the reason for the choice. Raise an InputError for an unknown engine.
    """
    if name not in ENGINES:
        raise InputError("engine", repr(name), one_of(ENGINES))
    if name == SUMO:
        system.require("SUMO", f"the engine {name}")
        system = replace(system, in_sumo=True)
    if reason := reason_against_scenes(system):
        return system, SUMO, reason
    return system, RECORDED, "nobody reacts to the vehicle under test"
