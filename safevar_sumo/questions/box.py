"""A box holds all settings between a lower and an upper end of each value, such as the limits of a
vehicle. This module draws settings from a box, and bounds the share of its unsafe settings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from safevar_sumo.questions.drives import Judged
from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import FeasibleRegion

MAX_CORNERS = 4096
"""Largest number of corners of a box that are simulated."""


@dataclass(frozen=True)
class Box:
    """All settings from `lower` to `upper`, each of shape (n,), that satisfy the constraints of the
    `region`. A value with equal ends does not vary.
    """

    region: FeasibleRegion
    lower: FloatArray
    upper: FloatArray

    def end(self, side: int, column: int) -> float:
        """The lower end of a column (side 0), or its upper end (side 1)."""
        return float((self.lower, self.upper)[side][column])

    def in_encounters_of(self, region: FeasibleRegion) -> Box:
        """The box with the same vehicles, and with all encounters of another region. The region is
        of the same vehicle, but its settings may have other values of encounters.
        """
        members = region.characteristics
        count = len(members.vehicle)
        return Box(
            region,
            np.concatenate([self.lower[:count], members.lower[count:]]),
            np.concatenate([self.upper[:count], members.upper[count:]]),
        )

    def at(self, points: FloatArray) -> FloatArray:
        """The settings at M points of the unit cube, shape (M, n): 0 is `lower`, 1 is `upper`."""
        return self.lower + points * (self.upper - self.lower)

    def holds(self, settings: FloatArray) -> BoolArray:
        """Which of M settings, shape (M, n), are in the box; shape (M,)."""
        is_within = ((settings >= self.lower) & (settings <= self.upper)).all(axis=1)
        return is_within & self.region.feasible(settings)

    def draw(self, number: int, rng: Generator) -> FloatArray:
        """Settings of the box, drawn uniformly, shape (number, n). The settings are fewer if hardly
        any setting satisfies the constraints.
        """
        return self.region.draw_feasible(
            lambda count: self.at(rng.random((count, len(self.lower)))), number
        )


class Proof(NamedTuple):
    """The result of a test with settings that were drawn after the box was chosen.

    Attributes
    ----------
    samples
        Number of settings that count.
    failures
        Number of these settings that are unsafe.
    at_most
        Upper bound, with `CONFIDENCE`, of the share of all settings of the box that are unsafe or
        cannot be simulated.
    not_simulated
        Number of the settings that could not be simulated, and are not among the failures.
    """

    samples: int
    failures: int
    at_most: float
    not_simulated: int


def proof_size(attempt: int, share: float) -> int:
    """The number of settings that the test number `attempt` (1, 2, ...) needs. If all of them are
    safe, at most `share` of the box is unsafe.
    """
    return math.ceil(math.log(_error_of(attempt)) / math.log1p(-share))


def _error_of(attempt: int) -> float:
    """The probability with which the test number `attempt` (1, 2, ...) may be wrong."""
    return (1 - CONFIDENCE) * 0.5**attempt


def prove(
    draw: Callable[[int], FloatArray],
    judge: Callable[[FloatArray], Judged],
    share: float,
    attempt: int,
) -> Proof:
    """Test whether at most `share` of the settings of a box are unsafe.

    Parameters
    ----------
    draw
        Returns new settings of the box, as many as it is asked for.
    judge
        Simulates M settings, each in the same E encounters, one setting after another.
    share
        The upper bound that the test needs.
    attempt
        The number of the test: 1 for the first box, 2 for the box that is tested next, and so on.

    Notes
    -----
    The settings are drawn independently and uniformly, by a random generator that no search uses.

    Several boxes may be tested in turn, until one of them passes. Let alpha be 1 - `CONFIDENCE`.
    Test k (k = 1, 2, ...) tests box k, and computes the upper bound of Clopper and Pearson at the
    confidence 1 - alpha_k, with alpha_k = alpha / 2^k. Box k depends only on the samples of earlier
    tests. So, whatever box k is, the bound of test k is wrong with a probability of at most
    alpha_k. The probability that the bound of any test is wrong is then at most the sum of all
    alpha_k, which is at most alpha. This also covers the bound of the box that passes.

    A later test has a smaller alpha_k, and therefore draws more settings: the bound is `share`
    again if all settings are safe.

    If all settings of the first test are safe, its bound is the usual one of a single test: it is
    computed at the confidence `CONFIDENCE`, and not at 1 - alpha_1, and is smaller than `share`.
    The probability that the bound of any test is wrong is then at most 1.5 alpha: alpha for the
    first test, and alpha / 2 for all later tests.
    """
    # scipy takes longer to load than a simulation takes: only a test loads it.
    import scipy

    # If all of these settings are safe, the bound is at most `share`.
    error = _error_of(attempt)
    settings = draw(proof_size(attempt, share))
    judged = judge(settings)

    def in_any_encounter(is_so: BoolArray) -> BoolArray:
        return np.asarray(is_so.reshape(len(settings), -1).any(axis=1))

    is_unsafe = in_any_encounter(judged.is_unsafe)
    has_failed = in_any_encounter(judged.counts & judged.failed)
    is_measured = in_any_encounter(judged.is_measured)

    # For the upper bound, a setting that could not be simulated counts as unsafe.
    samples = int(np.count_nonzero(is_measured | is_unsafe | has_failed))
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
