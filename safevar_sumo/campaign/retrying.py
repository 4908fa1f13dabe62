"""Batches that fail are tried once more, then row by row, which finds the setting that fails.

A setting that fails again by itself, while the original vehicle can be simulated, gets the outcome `simulator-error`.
Faults of the environment (disk, network files, memory) and of user code end the study, which the same command resumes
later.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor

import numpy as np

from safevar_sumo.campaign.pool import Pool, PoolLostError, WorkerLostError, wait_for_result
from safevar_sumo.errors import EnvironmentFault, SafevarError, SimulationError, UserCodeError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, user_code_names
from safevar_sumo.vehicles import CharacteristicSet

ATTEMPTS = 2
"""Number of attempts for a whole batch, and for a single setting: another process may have killed the worker."""
COMMAND_PREFIX = "; to reproduce it: "
MAX_FAILURES_IN_A_ROW = 20
"""Number of failing settings in a row from which on the study is at fault."""
RETRIED_ERRORS = (SimulationError, WorkerLostError, EnvironmentFault)

Compute = Callable[[FloatArray], Evaluations]
"""A function that evaluates k settings of n characteristics, shape (k, n), or raises an error."""


class Retries:
    """Evaluates batches of a study that may fail; too many failing settings in a row are an error."""

    def __init__(self, study: Study) -> None:
        self._study, self._failures_in_a_row = study, 0
        self.characteristics = CharacteristicSet.of(study)
        self._user_code = user_code_names(study)

    def evaluate(self, compute: Compute, settings: FloatArray, *, must_succeed: bool = False) -> Iterator[Evaluations]:
        """Yield the evaluations of k filtered settings, shape (k, n), in their order: of all together or, after
        failures, row by row.

        With `must_succeed` a failure is an error, not an outcome.
        """
        for _ in range(ATTEMPTS):
            try:
                evaluations = compute(settings)
            except UserCodeError as error:
                raise self._with_command(error, self._culprit(compute, settings)) from None
            except RETRIED_ERRORS as error:
                failure = error
            else:
                self._failures_in_a_row = 0
                yield evaluations
                return
        if isinstance(failure, EnvironmentFault):
            raise failure
        if len(settings) == 1:
            yield self._judge(compute, settings, failure, must_succeed=must_succeed)
            return
        for row in range(len(settings)):
            try:
                evaluations = compute(settings[[row]])
            except RETRIED_ERRORS as error:
                yield self._judge(compute, settings[[row]], error, must_succeed=must_succeed)
            else:
                self._failures_in_a_row = 0
                yield evaluations

    def _judge(
        self, compute: Compute, setting: FloatArray, failure: SafevarError, *, must_succeed: bool
    ) -> Evaluations:
        """The outcome of a setting that has failed: first the original vehicle is simulated, then the setting again."""
        if self._user_code and isinstance(failure, WorkerLostError):
            problem = f"{failure} at every attempt, probably in {' and '.join(self._user_code)}"
            raise self._with_command(UserCodeError(f"study {self._study.name!r}", problem), setting)
        if must_succeed:
            raise failure
        try:
            compute(self.characteristics.original[np.newaxis])
        except RETRIED_ERRORS as fault:
            raise EnvironmentFault(f"{failure}; the original vehicle cannot be simulated either: {fault}") from None
        try:
            return compute(setting)
        except (SimulationError, WorkerLostError) as error:
            self._failures_in_a_row += 1
            if self._failures_in_a_row >= MAX_FAILURES_IN_A_ROW:
                raise
            return self._failed_evaluation(setting, error)

    def _failed_evaluation(self, setting: FloatArray, error: SafevarError) -> Evaluations:
        undefined, own = np.full(1, np.nan), setting[:, : len(self.characteristics)]  # without an ADS's parameters
        return Evaluations(
            settings=setting,
            outcome=np.array([Outcome.SIMULATOR_ERROR.value], dtype="U16"),
            collision_speed=undefined,
            metrics=dict.fromkeys(METRICS, undefined),
            f_diff=self.characteristics.largest_change(own),
            f_num_diff=self.characteristics.number_changed(own),
            reasons={setting[0].tobytes(): " ".join(str(error).split())},
        )

    def _culprit(self, compute: Compute, settings: FloatArray) -> FloatArray:
        """A setting on which user code fails, found by halving, shape (1, n)."""
        while len(settings) > 1:
            half = settings[: len(settings) // 2]
            try:
                compute(half)
            except UserCodeError:
                settings = half
            else:
                settings = settings[len(half) :]
        return settings

    def _with_command(self, error: UserCodeError, setting: FloatArray) -> UserCodeError:
        """The error, with a command that reproduces it if the error has no command yet."""
        if COMMAND_PREFIX in error.problem:
            return error
        command = reproduction_command(self._study, setting[0, : len(self.characteristics)])
        return UserCodeError(error.source, f"{error.problem}{COMMAND_PREFIX}{command}", error.legal)


class RetryingPool:
    """A pool whose batches are tried again as `Retries` says."""

    def __init__(self, pool: Pool, study: Study) -> None:
        self._pool, self._retries = pool, Retries(study)
        self._threads = ThreadPoolExecutor(2 * pool.workers, thread_name_prefix="batch")

    @property
    def workers(self) -> int:
        """Number of batches that are computed at the same time."""
        return self._pool.workers

    def evaluate_original(self, work: bytes, *, must_succeed: bool = True) -> Evaluations:
        """The evaluation of the original vehicle of a packed study; by default a failure is an error."""
        original = self._retries.characteristics.original[np.newaxis]
        return wait_for_result(self.submit(work, original, must_succeed=must_succeed))

    def submit(self, work: bytes, settings: FloatArray, *, must_succeed: bool = False) -> Future[Evaluations]:
        """Evaluate k filtered settings of n characteristics, shape (k, n); with `must_succeed` a failure is an error,
        not an outcome.
        """

        def compute(batch: FloatArray) -> Evaluations:
            try:
                return self._pool.submit(work, batch).result()
            except CancelledError:
                raise PoolLostError("the pool was closed") from None

        def evaluate() -> Evaluations:
            return Evaluations.concatenate(list(self._retries.evaluate(compute, settings, must_succeed=must_succeed)))

        return self._threads.submit(evaluate)


def reproduction_command(study: Study, setting: FloatArray) -> str:
    """The command that simulates a setting of n characteristics, shape (n,), in a study or at the point to which it was
    reduced.
    """
    characteristics = CharacteristicSet.of(study)
    point = ["--point", shlex.quote(study.origin.point)] if study.origin.point else []
    changes = [
        f"--set {characteristic.name}={value!r}"
        for characteristic, value in zip(characteristics, setting.tolist(), strict=True)
        if value != characteristic.original
    ]
    is_beyond = ((setting < characteristics.lower) | (setting > characteristics.upper)).any()
    switches = {"--no-filter": (characteristics.filter(setting) != setting).any(), "--beyond": is_beyond}
    switches_on = [switch for switch, is_on in switches.items() if is_on]
    return " ".join(
        [f"{PROGRAM_COMMAND} simulate", shlex.quote(study.origin.called or study.name), *point, *changes, *switches_on]
    )
