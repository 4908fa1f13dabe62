"""What counts as unsafe, a collision or a safety degree below a limit; and how sure a share of unsafe settings is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.records import BoolArray, Evaluations, Outcome
from safevar_sumo.results import half_of

EXPECTED = "collision, points=X with X points of a rating, or below=X with a safety degree X [m, or minus a collision's speed in m/s]"
CONFIDENCE = 0.95
"""Of the intervals of shares, where no option says otherwise."""
FIRST, DECIMALS = 1.0, 6
"""Loss of points that counts as unsafe in a rated study, and decimals of points."""
PROBED = 1024
"""Settings over the whole domain that decide whether a study has collisions at all."""


@dataclass(frozen=True)
class Unsafe:
    """A collision; or, with `below`, a safety degree below that limit [m, or -m/s]; or, with `points`, no more points of a rating."""

    below: float | None = None
    points: float | None = None

    def __str__(self) -> str:
        if self.points is not None:
            return f"points={self.points!r}"
        return "collision" if self.below is None else f"below={self.below!r}"

    def of(self, evaluations: Evaluations) -> BoolArray:
        """Which evaluations are unsafe; shape (M,). An undefined safety degree is not unsafe."""
        if self.points is not None:
            return np.asarray(evaluations.column(RATING_POINTS.name) <= self.points)
        return evaluations.collided if self.below is None else np.asarray(evaluations.f_safe < self.below)

    @classmethod
    def parse(cls, criterion: Criterion) -> Unsafe:
        """The criterion that `--unsafe` or an argument `unsafe` states: a text, or a number X for `below=X`.

        Raises
        ------
        InputError
            If it is neither.
        """
        if isinstance(criterion, Unsafe):
            return criterion
        if criterion == "collision":
            return cls()
        kind, _, text = criterion.partition("=") if isinstance(criterion, str) else ("below", "", criterion)
        try:
            below = float(text) if kind in ("below", "points") else math.nan
        except (TypeError, ValueError):
            below = math.nan
        if not math.isfinite(below):
            raise InputError("unsafe", repr(criterion), EXPECTED)
        return cls(points=below) if kind == "points" else cls(below)

    @classmethod
    def first_point(cls, points: float) -> Unsafe:
        """The default of a rated study: a vehicle that has lost the first of the original's points.

        Raises
        ------
        InputError
            If the original has none to lose.
        """
        if not points >= FIRST:
            raise InputError("unsafe", f"the original vehicle earns {points:g} points and has none to lose", EXPECTED)
        return cls(points=round(points - FIRST, DECIMALS))

    @classmethod
    def usual(cls, evaluations: Evaluations, original: Evaluations) -> Unsafe:
        """The default: a collision if any evaluation is one, else a safety degree below half of the original's.

        Raises
        ------
        InputError
            If nothing collides and the original's safety degree is no distance.
        """
        if RATING_POINTS.name in original.metrics:
            return cls.first_point(float(original.column(RATING_POINTS.name)[0]))
        if evaluations.collided.any() or original.collided.any():
            return cls()
        if not original.f_safe[0] > 0:
            raise InputError("unsafe", "nothing collides, and the original vehicle has no safety degree to halve", EXPECTED)
        return cls(half_of(float(original.f_safe[0])))

    @classmethod
    def of_solutions(cls, solutions: pd.DataFrame, degree: float) -> Unsafe:
        """The default for solutions, as `safevar_sumo.results.unsafe_rows` applies it; `degree` is the original's safety degree, or its
        points in a rated study.
        """
        if RATING_POINTS.name in solutions:
            return cls.first_point(degree)
        collide = (solutions["outcome"] == str(Outcome.COLLISION)).any()
        return cls() if collide or math.isnan(degree) else cls(half_of(degree))


Criterion = Unsafe | float | str
"""What an argument `unsafe` takes: `Unsafe`, a number X for a safety degree below X, "collision" or "below=X"."""


def criterion_of(text: str | None, bench: Bench, original: Evaluations | None = None) -> Unsafe:
    """The criterion that an option states, by default the usual one; raises as `Unsafe.parse` and `Unsafe.usual`."""
    if text is not None:
        return Unsafe.parse(text)
    original = bench.original() if original is None else original
    if RATING_POINTS.name in original.metrics:
        return Unsafe.usual(original, original)
    return Unsafe.usual(bench.evaluate(bench.spread(PROBED), "settings over the whole domain"), original)


def clopper_pearson(count: int, total: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Clopper and Pearson's exact interval of the share count / total."""
    interval = scipy.stats.binomtest(count, total).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
