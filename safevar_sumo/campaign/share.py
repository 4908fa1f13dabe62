"""A share of a study's runs, which one worker carries out together: their searches wait for common
batches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from itertools import groupby, zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from safevar_sumo.campaign.cluster import has_caller
from safevar_sumo.campaign.evaluation import Task, evaluate_settings, repeat_first_batch, system_of
from safevar_sumo.campaign.identity import refuse_changed_inputs
from safevar_sumo.campaign.runs import (
    Run,
    RunKey,
    RunResult,
    algorithm_of,
    problem_of,
    random_generator_of,
)
from safevar_sumo.errors import InputError, SafevarError, UserCodeError, about
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.results import MANIFEST, Journal, identity_digest, journal_file, journal_head
from safevar_sumo.sumo.verification import Sample, spread_points, verify_sample

MAX_NAMES = 6
"""Largest number of runs that the name of a share lists."""
SAFE_SIMULATIONS = 300
"""Number of safe simulations of all shares that SUMO repeats besides the unsafe solutions."""


class Share(NamedTuple):
    """Some of a study's runs.

    Attributes
    ----------
    keys
        The runs.
    directory
        The directory of the journals, which the worker must see.
    manifest
        The inputs of the study's results, which the worker must share.
    original
        The original vehicle's evaluation.
    verifies
        Whether to verify results in SUMO.
    number, of
        The number of this share from 0, and of all shares.
    retry_failed
        Whether settings are simulated again that failed before.
    """

    keys: Sequence[RunKey]
    directory: Path
    manifest: JsonObject
    original: Evaluations
    verifies: bool
    retry_failed: bool
    number: int = 0
    of: int = 1

    def __str__(self) -> str:
        named = ", ".join(map(str, self.keys[:MAX_NAMES]))
        more = len(self.keys) - MAX_NAMES
        return f"runs {named}{f' and {more} more' if more > 0 else ''}"


def verification_file(directory: Path, key: RunKey) -> Path:
    """The file that says how far the verification of a share has come, by its first run."""
    return journal_file(directory, str(key)).with_suffix(".verified")


def carry_share(task: Task, share: Share) -> tuple[list[RunResult], str]:
    """Carry out runs in rounds, each of which evaluates all settings that their searches wait for;
    then verify and finish them. Also returns a remark on the verification, "" without any.

    Raises
    ------
    SafevarError
        If another process works on a run, a journal cannot be written, or user code fails.
    InputError
        If this worker does not see the directory or has other inputs, or results differ in SUMO.
    """
    if not (share.directory / MANIFEST).exists():
        raise InputError(
            "out",
            f"a worker does not see {share.directory}",
            "a directory on a disk that all workers share",
        )
    refuse_changed_inputs(task.study, system_of(task.study), share.manifest)
    with about(task.study.source), ExitStack() as stack:
        runs = [stack.enter_context(closing(_begin(task, share, key))) for key in share.keys]
        # Each search goes on until it asks for settings that are in no journal; a run's settings
        # are neighbours.
        worst = dict[bytes, int]()
        while missing := [(run, setting) for run in runs for setting in run.look_up()]:
            for rows in np.array_split(
                np.arange(len(missing)), math.ceil(len(missing) / task.batch_size)
            ):
                if not has_caller():
                    raise SafevarError("nobody waits for these runs any more")
                owners = [missing[row][0] for row in rows]
                evaluations = evaluate_settings(task, np.stack([missing[row][1] for row in rows]))
                worst |= _worst_points(evaluations)
                for run, rows_of_run in groupby(range(len(rows)), owners.__getitem__):
                    run.receive(evaluations.take([*rows_of_run]))
        remark = (
            _verify(task, share, [run for run in runs if not run.is_finished], worst)
            if share.verifies
            else ""
        )
        refuse_changed_inputs(task.study, system_of(task.study), share.manifest)
        try:
            repeat_first_batch(task.study)
        except UserCodeError:
            for key in share.keys:  # what they hold is not repeatable, and is not continued
                journal_file(share.directory, str(key)).unlink(missing_ok=True)
            raise
        return [run.finish() for run in runs], remark


def _begin(task: Task, share: Share, key: RunKey) -> Run:
    """Open the journal of a run and begin its search."""
    study = task.study
    system = system_of(task.study)
    path = journal_file(share.directory, str(key))
    head = journal_head(identity_digest(share.manifest), str(key), system.characteristics.names)
    problem = problem_of(study, system, share.original)
    search = algorithm_of(key.algorithm, study).search(problem, random_generator_of(study, key))
    journal = Journal(path, head, retry_failed=share.retry_failed)
    return Run(key, search, journal, study.search.evaluations)


def _verify(task: Task, share: Share, runs: Sequence[Run], worst: dict[bytes, int]) -> str:
    """Verify results of runs in SUMO; returns a remark, "" without any. `worst` has the numbers of
    the worst points of settings that were simulated now.
    """
    if not runs:
        return ""
    system = system_of(task.study)
    requested = Evaluations.concatenate([run.requested() for run in runs])
    solutions = Evaluations.concatenate([run.solutions for run in runs])
    criterion = Unsafe.default(
        {name: float(values[0]) for name, values in share.original.metrics.items()},
        solutions.outcome,
    )

    # A part of the safe simulations, at some of the points.
    spread = spread_points(system)
    points = spread[share.number % len(spread) :: min(share.of, len(spread))]
    number = math.ceil(SAFE_SIMULATIONS / share.of)
    unsafe, others = settings_to_verify(requested, solutions, criterion, number)

    # Of an earlier command's simulations the worst points are not known.
    unknown = [setting for setting in unsafe if setting.tobytes() not in worst]
    if unknown:
        found = evaluate_settings(task, np.stack(unknown))
        worst |= _worst_points(found)
    worst_points = np.array([worst[setting.tobytes()] for setting in unsafe], dtype=np.intp)
    counter = verification_file(share.directory, share.keys[0])
    total = len(unsafe) + number

    def show(repeated: int) -> None:
        with suppress(OSError):
            counter.write_text(f"{repeated} {total}")

    show(0)
    try:
        sample = Sample(unsafe, worst_points, others, number, points)
        return verify_sample(system, criterion, sample, show)[1]
    finally:
        with suppress(OSError):
            counter.unlink()


def _worst_points(evaluations: Evaluations) -> dict[bytes, int]:
    keys = map(np.ndarray.tobytes, evaluations.settings)
    return dict(zip(keys, evaluations.points.tolist(), strict=True))


def verify_safe(task: Task, settings: FloatArray) -> None:
    """Verify as many safe simulations of some settings, shape (M, n), as a search does."""
    system = system_of(task.study)
    no_points = np.zeros(0, dtype=np.intp)
    points = spread_points(system)
    sample = Sample(settings[:0], no_points, settings, SAFE_SIMULATIONS, points)
    verify_sample(system, Unsafe(), sample, lambda repeated: None)


def settings_to_verify(
    requested: Evaluations, solutions: Evaluations, criterion: Unsafe, number: int
) -> tuple[FloatArray, FloatArray]:
    """Every distinct unsafe solution, shape (k, n), and of the other settings that the searches
    requested, `number` with the least clearance of the safe ones, and as many spread evenly over
    each kind of outcome, in turns.
    """
    unsafe = np.unique(solutions.settings[criterion.of(solutions) & ~solutions.failed], axis=0)
    known = {setting.tobytes() for setting in unsafe}
    is_known = np.array([setting.tobytes() in known for setting in requested.settings], dtype=bool)
    others = requested.take(~is_known & ~requested.failed)
    safe = np.flatnonzero(~criterion.of(others))
    choices = [safe[np.argsort(criterion.robustness(others)[safe], kind="stable")]]
    for outcome in np.unique(others.outcome):
        of_kind = np.flatnonzero(others.outcome == outcome)
        spread = np.linspace(0, len(of_kind) - 1, min(number, len(of_kind))).astype(int)
        choices.append(of_kind[np.random.default_rng(0).permutation(spread)])

    # They take turns, so that the first ones are of every kind.
    turns = zip_longest(*(rows[:number].tolist() for rows in choices))
    rows = dict.fromkeys(row for turn in turns for row in turn if row is not None)
    return unsafe, others.settings[[*rows]]
