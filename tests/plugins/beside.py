"""What tests write beside a study file."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.sumo.system import System
from safevar_sumo.workers.evaluation import evaluate_batch

Mine = Callable[..., System]
SCALAR = "from safevar_sumo.ads import ScalarAds\n\n\nclass Mine(ScalarAds):\n"
ADS = '[ads]\nmodel = "mine:Mine"\n'

class InThisProcess:
    """A pool that computes at once."""

    workers = 1

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        try:
            future.set_result(evaluate_batch(study, settings))
        except Exception as error:
            future.set_exception(error)
        return future
