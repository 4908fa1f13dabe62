"""A pool that retries a failed batch: first the whole batch, then smaller and smaller parts, down to the setting that fails.

A setting that fails again by itself, while the original vehicle can be simulated, gets the outcome `simulator-error`. Faults of the
environment (disk, network files, memory) and of user code end the study, which the same command resumes later.
"""

from __future__ import annotations

import shlex
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial

import numpy as np

from safevar_sumo.errors import EnvironmentFault, SafevarError, SimulationError, UserCodeError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, user_code_names
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool, PoolLostError, WorkerLostError

BatchCallback = Callable[[Evaluations | None, BaseException | None], None]
"""Callback for a finished batch, with its evaluations or its error."""
ATTEMPTS = 2
"""Number of attempts for a whole batch, and for a single setting in a part: another process may have killed the worker."""
PARTS_PER_SPLIT = 8
"""Number of parts of a failing batch: with 8, one fatal setting among 200 costs five time limits."""
COMMAND_PREFIX = "; to reproduce it: "
MAX_FAILURES_IN_A_ROW = 20
"""Number of failing settings in a row from which on the study is at fault."""


class RetryingPool:
    """Gives settings that fail by themselves the outcome `simulator-error`; too many in a row are an error.

    Parameters
    ----------
    pool
        Computes batches.
    study
        The study of the settings.
    note_files
        Called with files that user code has read and that were unknown when the study began; may raise an error.
    """

    def __init__(self, pool: Pool, study: Study, note_files: Callable[[Mapping[str, str]], None] = lambda files: None) -> None:
        self._pool, self._study, self._note_files, self._failures_in_a_row = pool, study, note_files, 0
        self._characteristics, self._user_code = CharacteristicSet.of(study.vehicle.characteristics), user_code_names(study)

    @property
    def workers(self) -> int:
        """Number of batches that are computed at the same time."""
        return self._pool.workers

    def submit(self, work: bytes, settings: FloatArray, *, must_succeed: bool = False) -> Future[Evaluations]:
        """Evaluate k filtered settings of n characteristics, shape (k, n); with `must_succeed` a failure is an error, not an outcome."""
        result: Future[Evaluations] = Future()
        is_single = len(settings) == 1 and not must_succeed
        self._attempt(work, settings, 2 * ATTEMPTS if is_single else ATTEMPTS, result, must_succeed)
        return result

    def _attempt(self, work: bytes, settings: FloatArray, attempts_left: int, result: Future[Evaluations], must_succeed: bool) -> None:
        def accept_or_retry(evaluations: Evaluations | None, error: BaseException | None) -> None:
            if evaluations is not None:
                self._failures_in_a_row = 0
                result.set_result(evaluations)
            elif isinstance(error, UserCodeError):
                self._locate_failure(work, settings, error, result)
            elif not isinstance(error, SimulationError | WorkerLostError | EnvironmentFault):
                result.set_exception(error)
            elif attempts_left > 1:
                self._attempt(work, settings, attempts_left - 1, result, must_succeed)
            elif isinstance(error, EnvironmentFault):
                result.set_exception(error)
            elif len(settings) > 1:
                self._evaluate_parts(work, settings, result)
            elif self._user_code and isinstance(error, WorkerLostError):
                result.set_exception(self._with_command(self._error_of_lost_workers(error), settings))
            elif must_succeed:
                result.set_exception(error)
            else:
                self._confirm_failure(work, settings, error, result)

        self._compute(work, settings, accept_or_retry)

    def _compute(self, work: bytes, settings: FloatArray, callback: BatchCallback) -> None:
        """Compute a batch once; call `callback` with the evaluations or the error."""
        def note_and_call(attempt: Future[Evaluations]) -> None:
            error = PoolLostError("the batch was cancelled") if attempt.cancelled() else attempt.exception()
            if error is None and attempt.result().files:
                try:
                    self._note_files(attempt.result().files)
                except SafevarError as refusal:
                    error = refusal
            callback(attempt.result() if error is None else None, error)

        try:
            attempt = self._pool.submit(work, settings)
        except PoolLostError as error:
            callback(None, error)
        else:
            attempt.add_done_callback(note_and_call)

    def _evaluate_parts(self, work: bytes, settings: FloatArray, result: Future[Evaluations]) -> None:
        """Split a failing batch into parts; a part that fails is split again."""
        parts = np.array_split(settings, min(PARTS_PER_SPLIT, len(settings)))
        results: dict[int, Evaluations] = {}
        lock = threading.Lock()

        def collect_part(index: int, part: Future[Evaluations]) -> None:
            with lock:
                if result.done():
                    return
                if part.exception() is not None:
                    result.set_exception(part.exception())
                    return
                results[index] = part.result()
                if len(results) == len(parts):
                    result.set_result(Evaluations.concatenate([results[index] for index in range(len(parts))]))

        for index, rows in enumerate(parts):
            if not result.done():
                part: Future[Evaluations] = Future()
                part.add_done_callback(partial(collect_part, index))
                self._attempt(work, rows, ATTEMPTS if len(rows) == 1 else 1, part, must_succeed=False)

    def _confirm_failure(self, work: bytes, setting: FloatArray, error: SafevarError, result: Future[Evaluations]) -> None:
        """Simulate the original vehicle, then the setting again; a setting that fails once more has the outcome `simulator-error`."""
        def after_repetition(evaluations: Evaluations | None, last_error: BaseException | None) -> None:
            if evaluations is not None:
                result.set_result(evaluations)
            elif isinstance(last_error, SimulationError | WorkerLostError):
                self._failures_in_a_row += 1
                if self._failures_in_a_row >= MAX_FAILURES_IN_A_ROW:
                    result.set_exception(last_error)
                else:
                    result.set_result(self._failed_evaluation(setting, last_error))
            else:
                result.set_exception(last_error)

        def after_original(evaluations: Evaluations | None, fault: BaseException | None) -> None:
            if evaluations is not None:
                self._compute(work, setting, after_repetition)
            else:
                result.set_exception(EnvironmentFault(f"{error}; the original vehicle cannot be simulated either: {fault}")
                                   if isinstance(fault, SimulationError | WorkerLostError) else fault)

        self._compute(work, self._characteristics.original[np.newaxis], after_original)

    def _failed_evaluation(self, setting: FloatArray, error: SafevarError) -> Evaluations:
        undefined = np.full(1, np.nan)
        return Evaluations(
            settings=setting, outcome=np.array([Outcome.SIMULATOR_ERROR.value], dtype="U16"), collision_speed=undefined,
            metrics=dict.fromkeys(METRICS, undefined), f_diff=self._characteristics.largest_change(setting),
            f_num_diff=self._characteristics.number_changed(setting), reasons={setting[0].tobytes(): " ".join(str(error).split())})

    def _locate_failure(self, work: bytes, settings: FloatArray, error: UserCodeError, result: Future[Evaluations]) -> None:
        """Find, by bisection, the setting on which user code fails; add the command that reproduces the error."""
        if len(settings) == 1:
            result.set_exception(self._with_command(error, settings))
            return
        halves = settings[:len(settings) // 2], settings[len(settings) // 2:]

        def after_second_half(_: Evaluations | None, part_error: BaseException | None) -> None:
            if isinstance(part_error, UserCodeError):
                self._locate_failure(work, halves[1], part_error, result)
            else:
                result.set_exception(error)

        def after_first_half(_: Evaluations | None, part_error: BaseException | None) -> None:
            if isinstance(part_error, UserCodeError):
                self._locate_failure(work, halves[0], part_error, result)
            else:
                self._compute(work, halves[1], after_second_half)

        self._compute(work, halves[0], after_first_half)

    def _error_of_lost_workers(self, error: WorkerLostError) -> UserCodeError:
        """The error for workers that repeatedly end or hang in user code."""
        problem = f"{error} at every attempt, probably in {' and '.join(self._user_code)}; a dead process cannot report file and line"
        return UserCodeError(f"study {self._study.name!r}", problem)

    def _with_command(self, error: UserCodeError, setting: FloatArray) -> UserCodeError:
        """The error, with a command that reproduces it if the error has no command yet."""
        if COMMAND_PREFIX in error.problem:
            return error
        return UserCodeError(error.source, f"{error.problem}{COMMAND_PREFIX}{reproduction_command(self._study, setting[0])}", error.legal)


def reproduction_command(study: Study, setting: FloatArray) -> str:
    """The command that simulates a setting of n characteristics, shape (n,), in a study or at the point to which it was reduced."""
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    point = ["--point", shlex.quote(study.origin.point)] if study.origin.point else []
    changes = [f"--set {characteristic.name}={value!r}"
               for characteristic, value in zip(characteristics, setting.tolist(), strict=True) if value != characteristic.original]
    is_beyond = ((setting < characteristics.lower) | (setting > characteristics.upper)).any()
    switches = {"--no-filter": (characteristics.filter(setting) != setting).any(), "--beyond": is_beyond}
    switches_on = [switch for switch, is_on in switches.items() if is_on]
    return " ".join([f"{PROGRAM_COMMAND} simulate", shlex.quote(study.origin.called or study.name), *point, *changes, *switches_on])
