"""SafeFuzzer, the fuzzing baseline of the published study (method section 6)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, SAFEVAR, Scoring
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Problem, Search

KEPT = 50
SAFETY_WEIGHT = 6.0
REDRAWS = 100
"""Number of times that an infeasible setting is drawn again."""
Number = Annotated[int, Meta(ge=1, le=1_000_000)]


class SafeFuzzer(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Changes a few characteristics of the original vehicle, in ranges that narrow towards less safe settings.

    Parameters
    ----------
    generation
        Number of settings of a generation.
    kept
        Number of settings with the best scores in the result.
    warm_up
        Evaluations before ranges are narrowed or a generation must improve.
    generations_between_updates, generations_without_improvement
        Number of generations between two updates of the ranges, and without an improvement before the search ends.
    safety_weight
        Weight of the first objective in the score; the other objectives have weight 1.
    """

    generation: Number = 50
    kept: Number = KEPT
    warm_up: Annotated[int, Meta(ge=0)] = 500
    generations_between_updates: Number = 5
    generations_without_improvement: Number = 5
    safety_weight: Annotated[float, Meta(ge=0, le=1e6)] = SAFETY_WEIGHT

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        ranges = _Ranges(problem)
        done: list[Evaluations] = []
        window: list[Evaluations] = []
        used = generation = unimproved = 0
        while used < problem.evaluations and unimproved < self.generations_without_improvement:
            settings = ranges.draw(min(self.generation, problem.evaluations - used), rng)
            earlier = Evaluations.concatenate(done) if done else None
            evaluated = yield settings
            used, generation = used + len(settings), generation + 1
            done.append(evaluated)
            window.append(evaluated)
            if earlier is not None and len(earlier) >= self.warm_up:
                unimproved = 0 if _improves(evaluated, earlier, problem.scoring, self.safety_weight, self.kept) else unimproved + 1
            if used >= self.warm_up and generation % self.generations_between_updates == 0:
                ranges.narrow(Evaluations.concatenate(window))
                window = []
        everything = Evaluations.concatenate(done)
        valid = everything.take(problem.scoring.valid(everything))
        return valid.take(np.argsort(_scores(valid, problem.scoring, self.safety_weight), kind="stable")[:self.kept])


class _Ranges:
    """Ranges from which values are drawn, and the largest number of characteristics changed."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._characteristics, self._scoring = problem, problem.characteristics, problem.scoring
        self._original = problem.scoring.values(problem.original)[0, 0]
        self.lower, self.upper = problem.characteristics.lower.copy(), problem.characteristics.upper.copy()
        self.most_changed = len(problem.characteristics)

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Filtered settings: each changes k of the characteristics, k uniform in 1..`most_changed`."""
        settings = np.stack([self._feasible_setting(rng) for _ in range(number)])
        return self._characteristics.filter(settings)

    def _feasible_setting(self, rng: np.random.Generator) -> FloatArray:
        """A setting drawn until it is feasible; after `REDRAWS`, one moved towards the original until it is feasible."""
        setting = self._setting(rng)
        for _ in range(REDRAWS):
            if self._problem.feasible(setting[np.newaxis])[0]:
                return setting
            setting = self._setting(rng)
        return np.asarray(self._problem.repaired(setting[np.newaxis])[0])

    def _setting(self, rng: np.random.Generator) -> FloatArray:
        setting = self._characteristics.original.copy()
        for i in rng.choice(len(setting), size=rng.integers(1, self.most_changed, endpoint=True), replace=False):
            setting[i] = self._value(i, rng)
        return setting

    def _value(self, i: int, rng: np.random.Generator) -> float:
        """A value drawn uniformly from the range outside the filter's band; the original value if the band covers the range."""
        original, threshold = self._characteristics.original[i], self._characteristics.threshold[i]
        below = max(original - threshold - self.lower[i], 0.0)
        above = max(self.upper[i] - original - threshold, 0.0)
        if below + above <= 0:
            return float(original)
        place = rng.uniform(0.0, below + above)
        return float(self.lower[i] + place if place < below else self.upper[i] - (place - below))

    def narrow(self, window: Evaluations) -> None:
        """Narrow the ranges to the mean change, up and down, of the settings in `window` that are less safe than the original."""
        unsafe = window.take(self._scoring.valid(window) & (self._scoring.values(window)[:, 0] < self._original))
        if not len(unsafe):
            return
        for i, original in enumerate(self._characteristics.original):
            values = unsafe.settings[:, i]
            if np.any(values > original):
                self.upper[i] = np.mean(values[values > original])
            if np.any(values < original):
                self.lower[i] = np.mean(values[values < original])
        self.most_changed = max(1, int(np.floor(np.mean(unsafe.f_num_diff) + 0.5)))


def _improves(generation: Evaluations, earlier: Evaluations, scoring: Scoring = SAFEVAR, safety_weight: float = SAFETY_WEIGHT,
              kept: int = KEPT) -> bool:
    """Whether a generation's best score is lower than the worst of the `kept` best earlier scores."""
    scores = _scores(Evaluations.concatenate([earlier, generation]), scoring, safety_weight)
    before, new = scores[:len(earlier)], scores[len(earlier):]
    best = np.sort(before[~np.isnan(before)])[:kept]
    new = new[~np.isnan(new)]
    return bool(new.size and (not best.size or new.min() < best[-1]))


def _scores(evaluations: Evaluations, scoring: Scoring = SAFEVAR, safety_weight: float = SAFETY_WEIGHT) -> FloatArray:
    """(6 SD_norm + f_diff + num_norm) / 8, lower is better; SD is normalised by min-max over `evaluations`; NaN where invalid.

    With other objectives the first one takes the place of SD, and further objectives are normalised by min-max, too.
    """
    values = np.where(scoring.valid(evaluations)[:, np.newaxis], scoring.values(evaluations), np.nan)
    score = safety_weight * _normalised(values[:, 0])
    for objective, column in zip(scoring.objectives[1:], values[:, 1:].T, strict=True):
        if objective.name == F_DIFF.name:
            score = score + column
        elif objective.name == F_NUM_DIFF.name:
            score = score + (column - 1) / max(evaluations.settings.shape[1] - 1, 1)
        else:
            score = score + _normalised(column)
    return np.asarray(score / (safety_weight + len(scoring.objectives) - 1))


def _normalised(values: FloatArray) -> FloatArray:
    """Values normalised to [0, 1] by their minimum and maximum; NaN stays NaN."""
    if np.all(np.isnan(values)):
        return values
    least, spread = np.nanmin(values), np.nanmax(values) - np.nanmin(values)
    return np.asarray((values - least) / spread if spread > 0 else values - least)
