"""A share of a study's runs, which a worker carries out together. The searches of these runs wait
for common batches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing
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
"""Largest share of failed settings that a study may skip."""
MAX_NAMES = 6
"""Largest number of runs that the text of a share names."""


class Share(NamedTuple):
    """A part of a study's runs.

    Attributes
    ----------
    keys
        The names of the runs.
    directory
        The directory of the journals, which the worker must see.
    manifest
        The inputs of the study's results, which must be the worker's inputs, too.
    original
        The evaluation of the original vehicle.
    retry_failed
        Whether settings are simulated again that failed before.
    """

    keys: Sequence[RunKey]
    directory: Path
    manifest: JsonObject
    original: Evaluations
    retry_failed: bool

    def __str__(self) -> str:
        names = ", ".join(str(key) for key in self.keys[:MAX_NAMES])
        surplus = len(self.keys) - MAX_NAMES
        if surplus > 0:
            return f"runs {names} and {surplus} more"
        return f"runs {names}"


def carry_share(task: Task, share: Share) -> list[RunResult]:
    """Carry out the runs of a share in rounds. In each round, all settings are evaluated for which
    the searches wait.

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
    # This worker may have other files than the caller. The second call at the end finds files that
    # were edited during the runs.
    study = task.study
    refuse_changed_inputs(study, system_of(study), share.manifest)
    with about(study.source), ExitStack() as stack:
        runs = [
            stack.enter_context(closing(_begin(task, share, key))) for key in share.keys
        ]
        while True:
            # Each search goes on until it asks for settings that are in no journal.
            requests = [run.look_up() for run in runs]
            settings = np.concatenate(requests)
            if not len(settings):
                break
            # The number of the run that waits for each setting.
            numbers = np.repeat(np.arange(len(runs)), [len(part) for part in requests])
            batch_count = math.ceil(len(settings) / task.batch_size)
            for rows in np.array_split(np.arange(len(settings)), batch_count):
                if not has_caller():
                    raise SafevarError("nobody waits for these runs any more")
                evaluations = evaluate_settings(task, settings[rows])
                for number in np.unique(numbers[rows]):
                    is_own = numbers[rows] == number
                    runs[number].receive(evaluations.take(is_own))
                if study.search.failed == "skip":
                    _refuse_failures(study, runs)
        refuse_changed_inputs(study, system_of(study), share.manifest)
        try:
            repeat_first_batch(study)
        except UserCodeError:
            # The journals hold results that cannot be repeated: nobody may continue from these
            # journals.
            for key in share.keys:
                journal_file(share.directory, str(key)).unlink(missing_ok=True)
            raise
        # `finish` draws the sample for SUMO with new random numbers of the run. The sample is the
        # same for a run that was searched now, and for a run that was read from its journal.
        return [run.finish(random_generator_of(study, run.key)) for run in runs]


def _refuse_failures(study: Study, runs: Sequence[Run]) -> None:
    """Refuse to skip more than `MAX_SKIPPED` of the settings of these runs."""
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
    """Open the journal of a run, and begin the run's search."""
    study = task.study
    system = system_of(study)
    path = journal_file(share.directory, str(key))
    head = journal_head(
        identity_digest(share.manifest), str(key), system.characteristics.names
    )
    problem = problem_of(study, system, share.original)
    with system.user_code():
        search = algorithm_of(key.algorithm, study).search(
            problem, random_generator_of(study, key)
        )
    journal = Journal(path, head, retry_failed=share.retry_failed)
    return Run(key, search, journal, study.search.evaluations, problem.scoring)
