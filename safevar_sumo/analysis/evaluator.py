"""Evaluates settings of a study for every question, and makes designs that cover its domain."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
import numpy as np

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS, RATING_POINTS, Unsafe
from safevar_sumo.protocol import part_of
from safevar_sumo.protocol.rater import is_rated, rater_of
from safevar_sumo.records import CellResults, Evaluations, FloatArray, Outcome
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, region_of
from safevar_sumo.workers.batches import evaluate_all, inputs_of
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.interrupts import first_of
from safevar_sumo.workers.local import available_cores, local_pool
from safevar_sumo.workers.retrying import RetryingPool

PARTS_PER_WORKER = 2
"""A rating's cells are divided into this many parts for each worker."""
CONFIDENCE = 0.95
"""Confidence level of the intervals of shares, unless an option sets another."""
PROBED = 1024
"""Number of settings over the whole domain that decide whether a study has collisions at all."""
Progress = Callable[[str, int, int], None]
"""Called with the stage, the number of its settings done so far, and their total."""


DRAWS_PER_FEASIBLE = 64
"""Maximum number of points drawn from a sequence for each feasible point."""


def silent(stage: str, done: int, total: int) -> None:
    """Progress that is not shown."""


class Evaluator:
    """Evaluates settings of one study as they are, without the filter, and makes designs that cover its domain.

    Attributes
    ----------
    simulated
        Number of settings evaluated so far.
    """

    def __init__(self, study: Study, pool: Pool, progress: Progress = silent) -> None:
        self.study, self.region = study, region_of(study)
        self.characteristics = self.region.characteristics
        self._pool, self.progress = pool, progress
        self.simulated = 0

    def evaluate(self, settings: FloatArray, stage: str, before: int = 0, total: int | None = None, *,
                 anywhere: bool = False) -> Evaluations:
        """Evaluate settings, shape (M, n); progress counts them in `stage`, of whose `total` settings `before` are done already.

        Unless `anywhere` is true, settings that violate a constraint of the study get the outcome `infeasible` without a simulation.
        """
        if self.region and not anywhere:
            feasible = self.region.feasible(settings)
            if not feasible.all():
                parts = [self.evaluate(settings[feasible], stage, before, total), self._infeasible(settings[~feasible])]
                order = np.argsort(np.argsort(~feasible, kind="stable"), kind="stable")
                return Evaluations.concatenate(parts).take(order)  # back to the order of settings: the feasible rows were evaluated first
        if not len(settings):
            return Evaluations.none(len(self.characteristics), METRICS)
        done, distinct = 0, len(np.unique(settings, axis=0))
        stage_total = distinct if total is None else total
        self.progress(stage, before, stage_total)

        def count(number: int) -> None:
            nonlocal done
            done += number
            self.progress(stage, before + done, stage_total)

        evaluations = evaluate_all(self.study, settings, self._pool, count)
        self.simulated += distinct
        return evaluations

    def _infeasible(self, settings: FloatArray) -> Evaluations:
        undefined = np.full(len(settings), np.nan)
        return Evaluations(
            settings=settings, outcome=np.full(len(settings), Outcome.INFEASIBLE.value, dtype="U16"), collision_speed=undefined,
            metrics=dict.fromkeys(METRICS, undefined), f_diff=self.characteristics.largest_change(settings),
            f_num_diff=self.characteristics.number_changed(settings))

    def even_design(self, number: int, seed: int = 0, *, filtered: bool = False) -> FloatArray:
        """Settings that cover the feasible part of the domain evenly; with `filtered` they are feasible after the filter."""
        if not self.region:
            return even_design(self.characteristics, number, seed)
        rng, drawn = np.random.default_rng(seed), 0

        def next_points(count: int) -> FloatArray:
            """The next points of the sequence."""
            nonlocal drawn
            drawn += count
            return even_design(self.characteristics, drawn, seed)[drawn - count:]

        return self.region.sampled(next_points, number, rng, filtered=filtered, rejections=DRAWS_PER_FEASIBLE)

    def cells(self, settings: FloatArray, stage: str) -> CellResults:
        """Results of settings, shape (M, n), in every cell of a rated study; the cells are divided among the workers.

        Raises
        ------
        SimulationError
            If a setting cannot be simulated.
        """
        rater = rater_of(self.study, self.study.source)
        assert rater is not None
        number = len(rater.protocol.cells)
        parts = min(PARTS_PER_WORKER * self._pool.workers, number)
        inputs, pool = inputs_of(self.study, self._pool), RetryingPool(self._pool, self.study)
        self.progress(stage, 0, number)
        futures = {pool.submit(packed(self.study, inputs, cells=(k, parts)), settings): k for k in range(parts)}
        parts_done, done = dict[int, CellResults](), 0
        while len(parts_done) < parts:
            for future in first_of([future for future, k in futures.items() if k not in parts_done]):
                evaluations = future.result()
                if evaluations.cells is None:
                    raise SimulationError(f"study {self.study.name!r}: a vehicle cannot be simulated: {evaluations.reason(0)}")
                parts_done[futures[future]] = evaluations.cells
                done += evaluations.cells.impact.shape[1]
                self.progress(stage, done, number)
        order = np.argsort(np.concatenate([part_of(rater.protocol, k, parts) for k in range(parts)]))
        self.simulated += len(settings)
        columns = zip(*(parts_done[k] for k in range(parts)), strict=True)
        return CellResults._make(np.concatenate(column, axis=1)[:, order] for column in columns)

    def original(self) -> Evaluations:
        """The original vehicle's evaluation.

        Raises
        ------
        SimulationError
            If the original vehicle cannot be simulated.
        """
        evaluations = self.evaluate(self.characteristics.original[np.newaxis], "original vehicle")
        if not evaluations.valid[0]:
            raise SimulationError(f"study {self.study.name!r} cannot be simulated with the original vehicle: {evaluations.outcome[0]}")
        return evaluations

    def criterion(self, stated: str | None, original: Evaluations | None = None) -> Unsafe:
        """The criterion that an option states, else the default one; raises as `parsed` and `Unsafe.default_among`."""
        if stated is not None:
            return self.parsed(stated)
        original = self.original() if original is None else original
        if RATING_POINTS.name in original.metrics:
            return Unsafe.default_among(original, original)
        return Unsafe.default_among(self.evaluate(self.even_design(PROBED), "settings over the whole domain"), original)

    def parsed(self, stated: str) -> Unsafe:
        """The criterion that an option states; raises as `Unsafe.parse`, and where it asks for points of a study that is not rated."""
        criterion = Unsafe.parse(stated)
        if criterion.points is not None and not is_rated(self.study):
            raise InputError("unsafe", f"{stated!r}: study {self.study.name!r} is not rated and has no points", "collision or below=X")
        return criterion

    def with_step(self, step: float) -> Evaluator:
        """An evaluator of the same study with another time step [s]."""
        metrics = msgspec.structs.replace(self.study.metrics, sampling_interval=None)  # the study's may be no multiple of this step
        return self.for_study(msgspec.structs.replace(self.study, step_length=step, metrics=metrics))

    def for_study(self, study: Study) -> Evaluator:
        """An evaluator of another study, on the same pool."""
        return Evaluator(study, self._pool, self.progress)


@contextmanager
def open_evaluator(study: Study, pool: Pool | None = None, jobs: int | None = None, progress: Progress = silent) -> Iterator[Evaluator]:
    """An evaluator on a given pool, or on `jobs` worker processes of its own, by default one for each core.

    Raises
    ------
    InputError
        If the study's models cannot be assembled.
    """
    if pool is not None:
        yield Evaluator(study, pool, progress)
        return
    assemble(study, study.source)
    with local_pool(jobs or available_cores(), study.search.time_limit) as local:
        yield Evaluator(study, local, progress)


def sobol_points(number: int, dimensions: int, seed: int) -> FloatArray:
    """Scrambled Sobol points in the unit cube, shape (number, dimensions); evenly spread where number is a power of two."""
    import scipy  # takes longer to load than a simulation

    points = scipy.stats.qmc.Sobol(dimensions, rng=np.random.default_rng(seed)).random_base2(max(0, math.ceil(math.log2(number))))
    return np.asarray(points[:number])


def even_design(characteristics: CharacteristicSet, number: int, seed: int = 0) -> FloatArray:
    """Settings that cover the whole domain evenly, shape (number, n)."""
    lower, upper = characteristics.lower, characteristics.upper
    return np.asarray(lower + sobol_points(number, len(characteristics), seed) * (upper - lower))


def clopper_pearson(count: int, total: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Clopper and Pearson's exact interval of the share count / total."""
    import scipy

    interval = scipy.stats.binomtest(count, total).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
