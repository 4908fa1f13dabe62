"""A share of a study's runs, which one worker carries out together: their searches wait for common
batches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from safevar_sumo.campaign.cluster import has_caller
from safevar_sumo.campaign.evaluation import (
    Task,
    evaluate_settings,
    repeat_first_batch,
    system_of,
)
from safevar_sumo.campaign.inputs import refuse_changed_inputs
from safevar_sumo.campaign.runs import (
    Run,
    RunKey,
    RunResult,
    algorithm_of,
    problem_of,
    random_generator_of,
)
from safevar_sumo.errors import InputError, SafevarError, UserCodeError, about
from safevar_sumo.plugins.contract import user_errors
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.results import (
    MANIFEST,
    Journal,
    identity_digest,
    journal_file,
    journal_head,
)
from safevar_sumo.study import Study

MAX_SKIPPED = 0.1
"""Largest share of settings that a study skips because they fail."""
MAX_NAMES = 6
"""Largest number of runs that the name of a share lists."""


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
    retry_failed
        Whether settings are simulated again that failed before.
    """

    keys: Sequence[RunKey]
    directory: Path
    manifest: JsonObject
    original: Evaluations
    retry_failed: bool

    def __str__(self) -> str:
        names = ", ".join(map(str, self.keys[:MAX_NAMES]))
        surplus = len(self.keys) - MAX_NAMES
        if surplus > 0:
            return f"runs {names} and {surplus} more"
        return f"runs {names}"


def carry_share(task: Task, share: Share) -> list[RunResult]:
    """Carry out runs in rounds, each of which evaluates all settings that their searches wait for.

    Raises
    ------
    SafevarError
        If another process works on a run, a journal cannot be written, or user code fails.
    InputError
        If this worker does not see the directory or has other inputs.
    """
    if not (share.directory / MANIFEST).exists():
        raise InputError(
            "out",
            f"a worker does not see {share.directory}",
            "a directory on a disk that all workers share",
        )
    # Before: this worker may have other files. Afterwards: somebody may have edited them meanwhile.
    study = task.study
    refuse_changed_inputs(study, system_of(study), share.manifest)
    with about(study.source), ExitStack() as stack:
        runs = []
        for key in share.keys:
            run = closing(_begin(task, share, key))
            runs.append(stack.enter_context(run))
        # Each search goes on until it asks for settings that are in no journal; a run's settings
        # are neighbours.
        while requests := [(run, setting) for run in runs for setting in run.look_up()]:
            batches = math.ceil(len(requests) / task.batch_size)
            for rows in np.array_split(np.arange(len(requests)), batches):
                if not has_caller():
                    raise SafevarError("nobody waits for these runs any more")
                owners, settings = zip(*(requests[row] for row in rows), strict=True)
                evaluations = evaluate_settings(task, np.stack(settings))
                for run, rows_of_run in groupby(range(len(rows)), owners.__getitem__):
                    run.receive(evaluations.take(list(rows_of_run)))
                if study.search.failed == "skip":
                    _refuse_failures(study, runs)
        refuse_changed_inputs(study, system_of(study), share.manifest)
        try:
            repeat_first_batch(study)
        except UserCodeError:
            # What the journals hold is not repeatable, and is not continued.
            for key in share.keys:
                journal_file(share.directory, str(key)).unlink(missing_ok=True)
            raise
        # SUMO repeats the same settings whether a run was searched now or read from its journal.
        return [run.finish(random_generator_of(study, run.key)) for run in runs]


def _refuse_failures(study: Study, runs: Sequence[Run]) -> None:
    """Refuse to skip more than `MAX_SKIPPED` of the settings of runs."""
    number = sum(len(run.failures) for run in runs)
    total = len(runs) * study.search.evaluations
    if number > MAX_SKIPPED * total:
        failures = next(run.failures for run in reversed(runs) if len(run.failures))
        problem = f"search.failed = 'skip': {number} settings failed, more than 10 % of {total}"
        reason = failures.reason(len(failures) - 1)
        raise UserCodeError(
            f"study {study.name!r}",
            f"{problem}; the last one: {reason}",
            "a simulator that fails less often; `study --retry-failed` tries them again",
        )


def _begin(task: Task, share: Share, key: RunKey) -> Run:
    """Open the journal of a run and begin its search."""
    study = task.study
    system = system_of(task.study)
    path = journal_file(share.directory, str(key))
    head = journal_head(
        identity_digest(share.manifest), str(key), system.characteristics.names
    )
    problem = problem_of(study, system, share.original)
    with user_errors(study.source):
        search = algorithm_of(key.algorithm, study).search(
            problem, random_generator_of(study, key)
        )
    journal = Journal(path, head, retry_failed=share.retry_failed)
    return Run(key, search, journal, study.search.evaluations, problem.scoring)
