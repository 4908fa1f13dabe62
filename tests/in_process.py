"""A campaign's surroundings in this process: a pool that computes at once, and an observer that nobody hears."""

from __future__ import annotations

from concurrent.futures import Future

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.workers.evaluation import evaluate_batch


class Here:
    """A pool that computes in this process, at once."""

    workers = 1

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        future.set_result(evaluate_batch(work, settings))
        return future


class Silent:
    """An observer that nobody hears."""

    def evaluated(self, *_: object) -> None: ...
    def finished(self, *_: object) -> None: ...
    def warned(self, message: str) -> None: ...
