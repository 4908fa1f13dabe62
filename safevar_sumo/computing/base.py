"""Evaluating a batch is a pure function that any process of any machine may run; here is the function and the seam."""

from __future__ import annotations

from concurrent.futures import Future
from functools import lru_cache
from typing import Protocol

import msgspec

from safevar_sumo.errors import SafevarError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.simulation import System, assemble, evaluate
from safevar_sumo.study import Study


class WorkerLostError(SafevarError):
    """The process that computed a batch died or was stopped for taking too long."""


class PoolLostError(SafevarError):
    """Nothing can be computed any more: whatever is tried again will fail again."""


class Pool(Protocol):
    """Computes batches somewhere; futures fail with `WorkerLostError`, `PoolLostError` or what the batch itself raised."""

    @property
    def workers(self) -> int:
        """How many batches are computed at the same time."""

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        """Evaluate filtered settings, shape (k, n), of a packed study."""


def packed(study: Study) -> bytes:
    """A study as it travels to a worker."""
    return msgspec.msgpack.encode(study)


def evaluate_batch(study: bytes, settings: FloatArray) -> Evaluations:
    """What a worker does: (study, settings) -> evaluations."""
    return evaluate(_system(study), settings)


@lru_cache(maxsize=4)
def _system(study: bytes) -> System:
    return assemble(msgspec.msgpack.decode(study, type=Study))
