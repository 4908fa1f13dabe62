"""Where the settings of one study are tried out: every question asks here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all
from safevar_sumo.workers.evaluation import Pool
from safevar_sumo.workers.local import available_cores, local_pool

Progress = Callable[[str, int, int], None]
"""Is told what is going on, how many settings of it are done, and how many there are."""


def silent(what: str, done: int, total: int) -> None:
    """Progress that nobody wants to see."""


class Bench:
    """Evaluates settings of one study as they are given: nothing is filtered here.

    Attributes
    ----------
    simulated
        How many settings were evaluated so far.
    """

    def __init__(self, study: Study, pool: Pool, progress: Progress = silent) -> None:
        self.study, self.characteristics = study, CharacteristicSet.of(study.vehicle.characteristics)
        self._pool, self.progress = pool, progress
        self.simulated = 0

    def evaluate(self, settings: FloatArray, what: str) -> Evaluations:
        """Evaluate settings, shape (M, n); `what` tells the progress what they are for."""
        if not len(settings):
            return Evaluations.none(len(self.characteristics), METRICS)
        done, total = 0, len(np.unique(settings, axis=0))
        self.progress(what, 0, total)

        def one_more(number: int) -> None:
            nonlocal done
            done += number
            self.progress(what, done, total)

        evaluations = evaluate_all(self.study, settings, self._pool, one_more)
        self.simulated += total
        return evaluations

    def original(self) -> Evaluations:
        """The original vehicle's evaluation.

        Raises
        ------
        SimulationError
            If it cannot be simulated.
        """
        evaluations = self.evaluate(self.characteristics.original[np.newaxis], "original vehicle")
        if not evaluations.valid[0]:
            raise SimulationError(f"study {self.study.name!r} cannot be simulated with the original vehicle: {evaluations.outcome[0]}")
        return evaluations

    def with_step(self, step: float) -> Bench:
        """The same, simulated with another time step [s]."""
        metrics = msgspec.structs.replace(self.study.metrics, sampling_interval=None)  # it need not be a multiple of this step
        return self.of(msgspec.structs.replace(self.study, step_length=step, metrics=metrics))

    def of(self, study: Study) -> Bench:
        """A bench of another study, on the same pool."""
        return Bench(study, self._pool, self.progress)


@contextmanager
def open_bench(study: Study, pool: Pool | None = None, jobs: int | None = None, progress: Progress = silent) -> Iterator[Bench]:
    """A bench on somebody's pool, or on `jobs` worker processes of its own (as many as there are cores).

    Raises
    ------
    InputError
        If the study's models cannot be assembled.
    """
    if pool is not None:
        yield Bench(study, pool, progress)
        return
    assemble(study)
    with local_pool(jobs or available_cores(), study.search.time_limit) as own:
        yield Bench(study, own, progress)
