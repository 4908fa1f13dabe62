"""A pool that does not give up because a worker did: again, then in ever smaller parts, then without the setting that is left."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from functools import partial

import numpy as np

from safevar_sumo.computing.base import Pool, PoolLostError
from safevar_sumo.errors import SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.vehicles import CharacteristicSet

ATTEMPTS = 2
"""How often a batch is tried as a whole, and a setting alone: somebody else may have killed the worker."""
PARTS = 8
"""Into how many parts a failing batch is split: of 200 settings, one that takes a worker with it costs five workers' time limits."""
FAILURES_IN_A_ROW = 20
"""So many settings that fail one after the other are a fault of the study, not of the settings."""


class PersistentPool:
    """Settings that fail alone are evaluated as `simulator-error`; too many of them in a row are an error."""

    def __init__(self, pool: Pool, characteristics: CharacteristicSet) -> None:
        self._pool, self._characteristics, self._in_a_row = pool, characteristics, 0

    @property
    def workers(self) -> int:
        """How many batches are computed at the same time."""
        return self._pool.workers

    def submit(self, study: bytes, settings: FloatArray, *, must_succeed: bool = False) -> Future[Evaluations]:
        """Evaluate filtered settings, shape (k, n); with `must_succeed` a failure is an error, not an outcome."""
        result: Future[Evaluations] = Future()
        alone = len(settings) == 1 and not must_succeed
        self._attempt(study, settings, 2 * ATTEMPTS if alone else ATTEMPTS, result, must_succeed)
        return result

    def _attempt(self, study: bytes, settings: FloatArray, attempts: int, into: Future[Evaluations], must_succeed: bool) -> None:
        def done(attempt: Future[Evaluations]) -> None:
            error = PoolLostError("the batch was cancelled") if attempt.cancelled() else attempt.exception()
            if error is None:
                self._in_a_row = 0
                into.set_result(attempt.result())
            elif isinstance(error, PoolLostError) or not isinstance(error, SafevarError):
                into.set_exception(error)
            elif attempts > 1:
                self._attempt(study, settings, attempts - 1, into, must_succeed)
            elif len(settings) > 1:
                self._in_parts(study, settings, into)
            else:
                self._give_up(settings, error, into, must_succeed)

        try:
            attempt = self._pool.submit(study, settings)
        except PoolLostError as error:
            into.set_exception(error)
        else:
            attempt.add_done_callback(done)

    def _in_parts(self, study: bytes, settings: FloatArray, into: Future[Evaluations]) -> None:
        """Part a batch that fails, and the parts that fail again: the others cost what they would have."""
        parts = np.array_split(settings, min(PARTS, len(settings)))
        found: dict[int, Evaluations] = {}
        lock = threading.Lock()

        def done(number: int, part: Future[Evaluations]) -> None:
            with lock:
                if into.done():
                    return
                if part.exception() is not None:
                    into.set_exception(part.exception())
                    return
                found[number] = part.result()
                if len(found) == len(parts):
                    into.set_result(Evaluations.concatenate([found[number] for number in range(len(parts))]))

        for number, rows in enumerate(parts):
            if not into.done():
                part: Future[Evaluations] = Future()
                part.add_done_callback(partial(done, number))
                self._attempt(study, rows, ATTEMPTS if len(rows) == 1 else 1, part, must_succeed=False)

    def _give_up(self, setting: FloatArray, error: SafevarError, into: Future[Evaluations], must_succeed: bool) -> None:
        self._in_a_row += 1
        if must_succeed or self._in_a_row >= FAILURES_IN_A_ROW:
            into.set_exception(error)
        else:
            into.set_result(self._failed(setting, error))

    def _failed(self, setting: FloatArray, error: SafevarError) -> Evaluations:
        undefined = np.full(1, np.nan)
        return Evaluations(
            settings=setting, outcome=np.array([Outcome.SIMULATOR_ERROR.value], dtype="U16"), collision_speed=undefined,
            metrics=dict.fromkeys(METRICS, undefined), f_diff=self._characteristics.largest_change(setting),
            f_num_diff=self._characteristics.number_changed(setting),
            reasons={setting[0].tobytes(): " ".join(str(error).split())})
