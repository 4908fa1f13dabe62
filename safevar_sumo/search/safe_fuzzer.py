"""SafeFuzzer, the fuzzing baseline of the published study (method section 6)."""

from __future__ import annotations

from typing import Self

import numpy as np
from msgspec import Struct

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.study import SearchTable

GENERATION = 50
KEPT = 50
"""How many of the best scores are the result."""
WARM_UP = 500
"""Evaluations before ranges are narrowed or a generation must improve."""
GENERATIONS_BETWEEN_UPDATES = 5
GENERATIONS_WITHOUT_IMPROVEMENT = 5
SAFETY_WEIGHT = 6.0
"""Weight of the safety degree in the score, in which change and number changed weigh 1 each."""


class SafeFuzzer(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Changes a few characteristics of the original vehicle, in ranges that narrow towards what was less safe."""

    @classmethod
    def of(cls, table: SearchTable) -> Self:
        return cls()

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        ranges = _Ranges(problem)
        done: list[Evaluations] = []
        window: list[Evaluations] = []
        asked = generation = lean = 0
        while asked < problem.evaluations and lean < GENERATIONS_WITHOUT_IMPROVEMENT:
            settings = ranges.draw(min(GENERATION, problem.evaluations - asked), rng)
            earlier = Evaluations.concatenate(done) if done else None
            evaluated = yield settings
            asked, generation = asked + len(settings), generation + 1
            done.append(evaluated)
            window.append(evaluated)
            if earlier is not None and len(earlier) >= WARM_UP:
                lean = 0 if _improves(evaluated, earlier) else lean + 1
            if asked >= WARM_UP and generation % GENERATIONS_BETWEEN_UPDATES == 0:
                ranges.narrow(Evaluations.concatenate(window))
                window = []
        everything = Evaluations.concatenate(done)
        valid = everything.take(everything.valid)
        return valid.take(np.argsort(_scores(valid), kind="stable")[:KEPT])


class _Ranges:
    """Where values are drawn, and how many characteristics change at the most."""

    def __init__(self, problem: Problem) -> None:
        self._characteristics, self._original = problem.characteristics, problem.original
        self.lower, self.upper = problem.characteristics.lower.copy(), problem.characteristics.upper.copy()
        self.most_changed = len(problem.characteristics)

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Filtered settings: each changes k of the characteristics, k uniform in 1..`most_changed`."""
        settings = np.repeat(self._characteristics.original[np.newaxis], number, axis=0)
        for setting in settings:
            changes = rng.choice(len(setting), size=rng.integers(1, self.most_changed, endpoint=True), replace=False)
            for i in changes:
                setting[i] = self._value(i, rng)
        return self._characteristics.filter(settings)

    def _value(self, i: int, rng: np.random.Generator) -> float:
        """Uniform in the range outside the filter's band; the original where nothing of the range lies outside it."""
        original, threshold = self._characteristics.original[i], self._characteristics.threshold[i]
        below = max(original - threshold - self.lower[i], 0.0)
        above = max(self.upper[i] - original - threshold, 0.0)
        if below + above <= 0:
            return float(original)
        place = rng.uniform(0.0, below + above)
        return float(self.lower[i] + place if place < below else self.upper[i] - (place - below))

    def narrow(self, window: Evaluations) -> None:
        """Towards the mean change, up and down, of what was less safe than the original since the last time."""
        unsafe = window.take(window.valid & (window.f_safe < self._original.f_safe[0]))
        if not len(unsafe):
            return
        for i, original in enumerate(self._characteristics.original):
            values = unsafe.settings[:, i]
            if np.any(values > original):
                self.upper[i] = np.mean(values[values > original])
            if np.any(values < original):
                self.lower[i] = np.mean(values[values < original])
        self.most_changed = max(1, int(np.floor(np.mean(unsafe.f_num_diff) + 0.5)))


def _improves(generation: Evaluations, earlier: Evaluations) -> bool:
    """Whether a generation's best score is lower than the worst of the best of all earlier ones."""
    scores = _scores(Evaluations.concatenate([earlier, generation]))
    before, now = scores[:len(earlier)], scores[len(earlier):]
    best = np.sort(before[~np.isnan(before)])[:KEPT]
    now = now[~np.isnan(now)]
    return bool(now.size and (not best.size or now.min() < best[-1]))


def _scores(evaluations: Evaluations) -> FloatArray:
    """(6 SD_norm + f_diff + num_norm) / 8, lower is better; SD by min-max over `evaluations`; NaN where it failed."""
    safety = np.where(evaluations.valid, evaluations.f_safe, np.nan)
    if np.all(np.isnan(safety)):
        return safety
    least, spread = np.nanmin(safety), np.nanmax(safety) - np.nanmin(safety)
    normalised = (safety - least) / spread if spread > 0 else safety - least
    number = (evaluations.f_num_diff - 1) / max(evaluations.settings.shape[1] - 1, 1)
    return np.asarray((SAFETY_WEIGHT * normalised + evaluations.f_diff + number) / (SAFETY_WEIGHT + 2))
