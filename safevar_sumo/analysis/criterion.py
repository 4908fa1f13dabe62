"""What counts as unsafe: a collision, or a safety degree below a limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.results import HALF
from safevar_sumo.vehicles import CharacteristicSet

LEGAL = "collision, or below=X with a safety degree X [m, or minus a collision's speed in m/s]"
LOOKED_AT = 1024
"""Settings over the whole domain that tell whether a study collides at all."""


@dataclass(frozen=True)
class Unsafe:
    """A collision; or, where `below` is given, a safety degree below it [m, or -m/s]."""

    below: float | None = None

    def __str__(self) -> str:
        return "collision" if self.below is None else f"below={self.below!r}"

    def of(self, evaluations: Evaluations) -> BoolArray:
        """Which evaluations are unsafe; shape (M,). What has no safety degree is not."""
        return evaluations.collided if self.below is None else np.asarray(evaluations.f_safe < self.below)

    @classmethod
    def parse(cls, text: str) -> Unsafe:
        """Read what --unsafe says.

        Raises
        ------
        InputError
            If it is something else.
        """
        kind, _, number = text.partition("=")
        if text == "collision":
            return cls()
        try:
            below = float(number) if kind == "below" else math.nan
        except ValueError:
            below = math.nan
        if not math.isfinite(below):
            raise InputError("unsafe", repr(text), LEGAL)
        return cls(below)

    @classmethod
    def given(cls, text: str | None) -> Unsafe | None:
        """Read what --unsafe says, if it says anything; raises as `parse`."""
        return None if text is None else cls.parse(text)

    @classmethod
    def usual(cls, evaluations: Evaluations, original: Evaluations) -> Unsafe:
        """A collision if one of the evaluations is one; else a safety degree below half of the original's.

        Raises
        ------
        InputError
            If nothing collides and the original's safety degree is no distance.
        """
        if evaluations.collided.any() or original.collided.any():
            return cls()
        if not original.f_safe[0] > 0:
            raise InputError("unsafe", "nothing collides, and the original vehicle has no safety degree to halve", LEGAL)
        return cls.half_of(float(original.f_safe[0]))

    @classmethod
    def half_of(cls, degree: float) -> Unsafe:
        """Below half of a safety degree [m], as exactly as one tells it."""
        return cls(float(f"{HALF * degree:.6g}"))


def usual_in(bench: Bench, original: Evaluations) -> Unsafe:
    """What is unsafe in a study of which nothing is known yet; raises as `Unsafe.usual`."""
    return Unsafe.usual(bench.evaluate(spread(bench.characteristics, LOOKED_AT), "settings over the whole domain"), original)


def sobol_points(number: int, dimensions: int, seed: int) -> FloatArray:
    """Scrambled Sobol points in the unit cube, shape (number, dimensions); evenly spread where number is a power of two."""
    points = scipy.stats.qmc.Sobol(dimensions, rng=np.random.default_rng(seed)).random_base2(max(0, math.ceil(math.log2(number))))
    return np.asarray(points[:number])


def spread(characteristics: CharacteristicSet, number: int, seed: int = 0) -> FloatArray:
    """Settings that cover the whole domain evenly, shape (number, n)."""
    lower, upper = characteristics.lower, characteristics.upper
    return np.asarray(lower + sobol_points(number, len(characteristics), seed) * (upper - lower))
