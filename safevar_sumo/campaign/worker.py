"""What a worker does with its job. It evaluates a batch; or it carries out a share of a study's runs: it searches,
simulates in batches over its runs, writes their journals and verifies their results.

A worker may die at any moment; the next one continues from the journals. It would meet again what killed the workers
before it. So it is told why they died: these attempts count as failed and are not repeated.
"""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from safevar_sumo.campaign.evaluation import Evaluate, refuse_unlike_sumo, system_of, task_of
from safevar_sumo.campaign.pool import Job, Report, Share, WorkerLostError
from safevar_sumo.campaign.run import Run, RunKey, make_search, random_generator_of
from safevar_sumo.errors import EnvironmentFault, InputError, SafevarError, SimulationError, UserCodeError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray, Outcome, differences
from safevar_sumo.results import MANIFEST, PATIENCE, Journal, JournalBusyError, journal_file, journal_head
from safevar_sumo.search import Problem
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, user_code_names
from safevar_sumo.sumo.matrix import MAX_COPIES
from safevar_sumo.vehicles import CharacteristicSet, region_of

ATTEMPTS = 2
"""Number of attempts for a whole batch, and for a single setting: another process may have killed the worker."""
COMMAND_PREFIX = "; to reproduce it: "
MAX_FAILURES_IN_A_ROW = 20
"""Number of failing settings in a row from which on the study is at fault."""
FAILURES = (SimulationError, WorkerLostError, EnvironmentFault)
"""Errors after which a batch is tried again."""
EXPECTED_RESULTS = (
    "results of a vehicle that depend on this vehicle alone: nothing kept in a class, a module or the model itself "
    "from one call or setting to another, no mean or sum over the batch, nothing random"
)


def carry_out_job(job: Job, report: Report, evaluate: Evaluate) -> None:
    """Carry out a job; `evaluate` evaluates its batches.

    Raises
    ------
    SafevarError
        If a journal cannot be written, the study is at fault, or a setting has another result alone or in SUMO.
    """
    attempts = Attempts(job, report, evaluate)
    if isinstance(job, Share):
        _ShareCarrier(job, report, attempts).carry_out()
    else:
        evaluations = attempts.evaluate(job.packed_task, job.settings, must_succeed=job.must_succeed)
        report(Evaluations.concatenate([*evaluations]))


class Attempts:
    """Evaluates the batches of a job. A batch that fails is evaluated once more, then row by row, to find the setting
    that fails.

    A setting that fails again alone, while the original vehicle can be simulated, gets the outcome
    `simulator-error`. Faults of the environment (disk, network files, memory) and of user code end the study, which the
    same command resumes later; so do too many failing settings in a row.
    """

    def __init__(self, job: Job, report: Report, evaluate: Evaluate) -> None:
        self._deaths = {setting: list(reasons) for setting, reasons in job.deaths.items()}
        self._report, self._evaluate, self._study = report, evaluate, task_of(job.packed_task).study
        self._characteristics, self._failures_in_a_row = CharacteristicSet.of(self._study), 0

    def evaluate(
        self, packed_task: bytes, settings: FloatArray, *, must_succeed: bool = False
    ) -> Iterator[Evaluations]:
        """Evaluate k filtered settings, shape (k, n); yields their evaluations in their order, all at once or, after
        failures, row by row.

        With `must_succeed` a failure is an error, not an outcome.
        """
        for _ in range(ATTEMPTS):
            try:
                evaluations = self._attempt(packed_task, settings)
            except UserCodeError as error:
                raise self._with_command(error, self._culprit(packed_task, settings)) from None
            except FAILURES as error:
                failure = error
            else:
                self._failures_in_a_row = 0
                yield evaluations
                return
        if len(settings) > 1 and not isinstance(failure, EnvironmentFault):
            for row in range(len(settings)):
                yield from self.evaluate(packed_task, settings[[row]], must_succeed=must_succeed)
            return
        names = user_code_names(self._study)
        if names and isinstance(failure, WorkerLostError):
            problem = f"{failure} at every attempt, probably in {' and '.join(names)}"
            raise self._with_command(UserCodeError(f"study {self._study.name!r}", problem), settings)
        if must_succeed or isinstance(failure, EnvironmentFault):
            raise failure
        try:
            self._attempt(packed_task, self._characteristics.original[np.newaxis])
        except FAILURES as fault:
            raise EnvironmentFault(f"{failure}; the original vehicle cannot be simulated either: {fault}") from None
        self._failures_in_a_row += 1
        if self._failures_in_a_row >= MAX_FAILURES_IN_A_ROW:
            raise failure
        yield self._failed_evaluation(settings, failure)

    def _attempt(self, packed_task: bytes, settings: FloatArray) -> Evaluations:
        """Evaluate a batch, unless an earlier worker died of this attempt."""
        setting = settings.tobytes() if len(settings) == 1 else b""
        if self._deaths.get(setting):
            raise WorkerLostError(self._deaths[setting].pop(0))
        self._report(setting)
        return self._evaluate(packed_task, settings)

    def _failed_evaluation(self, setting: FloatArray, error: SafevarError) -> Evaluations:
        undefined, values = np.full(1, np.nan), setting[:, : len(self._characteristics)]  # without the ADS's parameters
        return Evaluations(
            settings=setting,
            outcome=np.array([Outcome.SIMULATOR_ERROR.value], dtype="U16"),
            collision_speed=undefined,
            metrics=dict.fromkeys(METRICS, undefined),
            f_diff=self._characteristics.largest_change(values),
            f_num_diff=self._characteristics.number_changed(values),
            reasons={setting[0].tobytes(): " ".join(str(error).split())},
        )

    def _culprit(self, packed_task: bytes, settings: FloatArray) -> FloatArray:
        """A setting on which user code fails, shape (1, n), found by halving the batch."""
        while len(settings) > 1:
            half = settings[: len(settings) // 2]
            try:
                self._attempt(packed_task, half)
            except UserCodeError:
                settings = half
            else:
                settings = settings[len(half) :]
        return settings

    def _with_command(self, error: UserCodeError, setting: FloatArray) -> UserCodeError:
        """The error, with a command that reproduces it if the error has no command yet."""
        if COMMAND_PREFIX in error.problem:
            return error
        command = reproduction_command(self._study, setting[0, : len(self._characteristics)])
        return UserCodeError(error.source, f"{error.problem}{COMMAND_PREFIX}{command}", error.legal)


def reproduction_command(study: Study, setting: FloatArray) -> str:
    """The command that simulates a setting of n characteristics, shape (n,), in a study, or at the only point to which
    the study was reduced.
    """
    characteristics, origin = CharacteristicSet.of(study), study.origin
    words = [f"{PROGRAM_COMMAND} simulate", shlex.quote(origin.called or study.name)]
    words += ["--point", shlex.quote(origin.point)] if origin.point else []
    words += [
        f"--set {characteristic.name}={value!r}"
        for characteristic, value in zip(characteristics, setting.tolist(), strict=True)
        if value != characteristic.original
    ]
    words += ["--no-filter"] if (characteristics.filter(setting) != setting).any() else []
    words += ["--beyond"] if ((setting < characteristics.lower) | (setting > characteristics.upper)).any() else []
    return " ".join(words)


class _ShareCarrier:
    """Carries out a share."""

    def __init__(self, share: Share, report: Report, attempts: Attempts) -> None:
        self._share, self._report, self._attempts, self._task = share, report, attempts, task_of(share.packed_task)
        self._study = self._task.study

    def carry_out(self) -> None:
        """Advance all runs in rounds, until their searches have ended: each round simulates what they wait for."""
        if not (self._share.directory / MANIFEST).exists():
            raise InputError(
                "out", f"a worker does not see {self._share.directory}", "a directory on a disk that all workers share"
            )
        runs = list[Run]()
        try:
            for run in self._begin():
                runs.append(run)
            while runs:
                ended = [run for run in runs if run.is_finished or run.advance()]
                self._verify([run for run in ended if not run.is_finished])
                for run in ended:
                    self._report(run.finish())
                runs = [run for run in runs if run not in ended]
                self._simulate(runs)
                self._report([run.progress for run in runs])
        finally:
            for run in runs:
                run.journal.close()

    def _begin(self) -> Iterator[Run]:
        """Open the journals and begin the searches of all runs that no other process carries out."""
        share, system, search = self._share, system_of(self._task), self._study.search
        problem = Problem(
            characteristics=system.characteristics,
            original=share.original,
            evaluations=search.evaluations,
            population=search.population,
            scoring=system.measuring.scoring,
            region=region_of(self._study),
        )
        deadline = time.monotonic() + PATIENCE
        for key in share.keys:
            path = journal_file(share.directory, str(key))
            try:
                journal = Journal(path, journal_head(share.identity, str(key), system.characteristics.names), deadline)
            except JournalBusyError:
                self._report(key)
                continue
            if journal.content.tail_size:
                self._report(journal.remark_on_tail)
            if share.retry_failed and journal.content.evaluations.failed.any():
                journal.retry()
            yield Run(key, make_search(key, self._study, problem), journal, search.evaluations)

    def _simulate(self, runs: Sequence[Run]) -> None:
        """Simulate and journal the settings that the runs wait for, in equal batches."""
        owners = [run for run in runs for _ in run.missing_settings]  # the run that waits for each setting
        if not owners:
            return
        settings = np.concatenate([run.missing_settings for run in runs])
        for evaluations in self._evaluate(self._share.packed_task, settings, self._share.batch_size):
            owners_of_rows, owners = owners[: len(evaluations)], owners[len(evaluations) :]
            for run in dict.fromkeys(owners_of_rows):
                rows = [row for row, owner in enumerate(owners_of_rows) if owner is run]
                run.receive(evaluations.take(rows))

    def _evaluate(self, packed_task: bytes, settings: FloatArray, size: int) -> Iterator[Evaluations]:
        """Evaluate settings in equal batches of at most `size` settings."""
        for batch in np.array_split(settings, math.ceil(len(settings) / size)):
            yield from self._attempts.evaluate(packed_task, batch)

    def _verify(self, runs: Sequence[Run]) -> None:
        """Simulate settings of ended runs again: alone, if there is user code, and in SUMO, if the runs used recorded
        scenes.
        """
        if user_code_names(self._study):
            for run in runs:
                self._verify_isolation(run)
        if self._share.sumo_task:
            self._verify_in_sumo(runs)

    def _verify_isolation(self, run: Run) -> None:
        """Refuse a run with a setting whose evaluation is another one alone, with user code loaded afresh."""
        task = self._task
        packed_task = msgspec.structs.replace(task, afresh=True).packed
        for expected in run.sample_evaluations(self._generator("recheck", run.key)):
            (isolated,) = self._attempts.evaluate(packed_task, expected.settings)
            if expected.failed[0] or isolated.failed[0]:
                continue
            for _, difference in differences(isolated.results, expected.results):
                problem = (
                    f"with {' and '.join(user_code_names(task.study))} a result depends on what else is simulated: "
                    f"{difference} in run {run.key}{COMMAND_PREFIX}"
                    f"{reproduction_command(task.study, expected.settings[0])}"
                )
                raise UserCodeError(f"study {task.study.name!r}", problem, EXPECTED_RESULTS)

    def _verify_in_sumo(self, runs: Sequence[Run]) -> None:
        samples = [run.sample_for_sumo(self._generator("verify", run.key)) for run in runs]
        if not any(map(len, samples)):
            return

        recorded = Evaluations.concatenate(samples)

        def evaluate(packed_task: bytes) -> Evaluations:
            return Evaluations.concatenate([*self._evaluate(packed_task, recorded.settings, MAX_COPIES)])

        in_sumo = evaluate(self._share.sumo_task)
        if self._share.recorded_task:  # SUMO repeats a few cells of a rating; the runs have no values of single cells
            recorded = evaluate(self._share.recorded_task)
        refuse_unlike_sumo(self._study, recorded, in_sumo)
        failed_rows = np.flatnonzero(in_sumo.failed)
        if len(failed_rows):
            names = ", ".join(str(run.key) for run in runs)
            self._report(
                f"runs {names}: {len(failed_rows)} of {len(in_sumo)} settings could not be verified in SUMO: "
                f"{in_sumo.reason(failed_rows[0])}"
            )

    def _generator(self, purpose: str, key: RunKey) -> np.random.Generator:
        """The random generator that draws the settings of a run to simulate again."""
        return random_generator_of(self._study, key._replace(algorithm=f"{purpose} {key.algorithm}"))
