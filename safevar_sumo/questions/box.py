"""Boxes of settings: a promise, limits; settings in them, and the proof that hardly any of them is
unsafe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import FeasibleRegion

MAX_CORNERS = 4096
"""Largest number of corners of a box that are simulated."""


@dataclass(frozen=True)
class Box:
    """Settings from `lower` to `upper`, shape (n,), that satisfy the constraints; where both ends
    are equal, a characteristic does not vary.
    """

    region: FeasibleRegion
    lower: FloatArray
    upper: FloatArray

    def end(self, side: int, column: int) -> float:
        """An end of a column: 0, the lower one, or 1, the upper one."""
        return float((self.lower, self.upper)[side][column])

    def in_encounters_of(self, region: FeasibleRegion) -> Box:
        """The box of its vehicles, in all encounters of another region of the same vehicle."""
        members = region.characteristics
        count = len(members.vehicle)
        return Box(
            region,
            np.concatenate([self.lower[:count], members.lower[count:]]),
            np.concatenate([self.upper[:count], members.upper[count:]]),
        )

    def at(self, points: FloatArray) -> FloatArray:
        """The settings at points of the unit cube, shape (M, n)."""
        return self.lower + points * (self.upper - self.lower)

    def holds(self, settings: FloatArray) -> BoolArray:
        """Which settings are in the box, shape (M,)."""
        is_within = ((settings >= self.lower) & (settings <= self.upper)).all(axis=1)
        return is_within & self.region.feasible(settings)

    def draw(self, number: int, rng: Generator) -> FloatArray:
        """Settings drawn uniformly, shape (number, n); fewer if hardly any is feasible."""
        return self.region.draw_feasible(
            lambda count: self.at(rng.random((count, len(self.lower)))), number
        )


class Proof(NamedTuple):
    """`failures` of `samples` settings drawn after the box was chosen, and those that could not be
    simulated; at most the share `at_most` of all is unsafe or cannot be simulated, with
    `CONFIDENCE`.
    """

    samples: int
    failures: int
    at_most: float
    not_simulated: int


def proof_size(attempt: int, share: float) -> int:
    """The number of settings of which none may be unsafe in a test, so that at most this share of
    all is.
    """
    return math.ceil(math.log(_error_of(attempt)) / math.log1p(-share))


def _error_of(attempt: int) -> float:
    """The probability with which a test may be wrong."""
    return float((1 - CONFIDENCE) * 0.5**attempt)


def prove(
    draw: Callable[[int], FloatArray],
    judge: Callable[[FloatArray], FloatArray],
    share: float,
    attempt: int,
) -> Proof:
    """Test with settings drawn anew that at most `share` of all are unsafe. The judge says what
    each of M settings leaves to the limit in E encounters, shape (M, E): NaN where it could not be
    simulated, infinite where it does not count.

    Notes
    -----
    The settings are drawn independently and uniformly, by a random generator that no search uses.
    Test k, k = 1, 2, ..., may be wrong with probability alpha_k = alpha / 2^k, alpha = 1 -
    `CONFIDENCE`: its bound is Clopper and Pearson's at confidence 1 - alpha_k. Box k depends on
    earlier samples alone, so given box k the bound fails with probability at most alpha_k. So the
    probability that any bound is wrong, and with it the bound of the box that passes, is at most
    sum alpha_k <= alpha. Later tests draw more settings, so that the bound stays `share` if all of
    them are safe. If all settings of the first test are safe, its bound is the one-sided one at
    `CONFIDENCE`: it is smaller than `share`, and a box between both passes as safe by no later
    test, whose bound is `share`.
    """
    # It takes longer to load than a simulation.
    import scipy

    # Samples enough for the bound, if all are safe.
    error = _error_of(attempt)
    settings = draw(proof_size(attempt, share))
    robustness = judge(settings)
    is_unsafe = (robustness < 0).any(axis=1)
    has_failed = np.isnan(robustness).any(axis=1)

    # An upper bound on the share, where a failed simulation counts as unsafe.
    samples = int(np.count_nonzero((robustness < np.inf).any(axis=1) | has_failed))
    failures = int(np.count_nonzero(is_unsafe))
    not_simulated = int(np.count_nonzero(has_failed & ~is_unsafe))
    safe = samples - failures - not_simulated
    if attempt == 1 and safe == len(settings):
        error = 1 - CONFIDENCE
    at_most = (
        float(scipy.special.betaincinv(samples - safe + 1, safe, 1 - error))
        if safe
        else 1.0
    )
    return Proof(samples, failures, at_most, not_simulated)
