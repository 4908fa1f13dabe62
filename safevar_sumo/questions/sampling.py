"""Random numbers, points that cover a domain evenly, and what a sample says about a share."""

from __future__ import annotations

import math
from enum import IntEnum

from numpy.random import Generator, default_rng

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Interval as Interval
from safevar_sumo.vehicles import CharacteristicSet

CONFIDENCE = 0.95
"""Confidence level of the intervals of shares, unless an option sets another level."""


class Stream(IntEnum):
    """What random numbers are drawn for: what one use draws does not depend on the others.

    Results depend on the numbers of the streams; a new use takes a new number.
    """

    CONFIDENCE_BOUND = 1  # vehicles within joint limits, for the upper confidence bound
    LARGER_BOXES = 2  # steps from the largest safe box that is known to larger ones
    JOINT_LIMITS = 4  # falsification of joint limits
    LIMITS_ALONE = 6  # falsification of the limits of one characteristic alone
    REPAIRED_BOUND = 7  # vehicles within the required range, for the bound of a repair
    # Falsification of a limit in place of a specified one that does not hold.
    NEAREST_LIMIT = 8
    # Falsification of limits in the ranges of a study.
    WIDER_SCOPE = 9
    EXTENSION = 10  # falsification of joint limits of which one is extended
    SPECIFIED_BETWEEN = 11  # specified limits between the tests of a matrix
    VALIDATION = 15  # further falsifications of joint limits that passed one
    FIRST_CORNERS = 17  # corners with which the test of joint limits begins
    PERMIT = 18  # search for counterexamples to the speed of a car

    def generator(self, seed: int, *counts: int) -> Generator:
        """The generator of a draw, by the seed of the study's search and what counts the draws."""
        return default_rng((seed, self, *counts))


def sobol_points(number: int, dimensions: int, seed: int) -> FloatArray:
    """Scrambled Sobol points in the unit cube, shape (number, dimensions); they are most even if
    `number` is a power of two.
    """
    import scipy  # takes longer to load than a simulation

    sequence = scipy.stats.qmc.Sobol(dimensions, rng=default_rng(seed))
    points: FloatArray = sequence.random_base2(max(0, math.ceil(math.log2(number))))
    return points[:number]


def sobol_settings(characteristics: CharacteristicSet, number: int) -> FloatArray:
    """`number` settings that cover the whole domain evenly, shape (number, n), feasible or not."""
    lower = characteristics.lower
    upper = characteristics.upper
    return lower + sobol_points(number, len(characteristics), 0) * (upper - lower)


def clopper_pearson(
    count: float, total: float, confidence: float = CONFIDENCE
) -> Interval:
    """Exact confidence interval (Clopper and Pearson) of the share `count` / `total`; its ends are
    quantiles of beta distributions, also between whole numbers.
    """
    import scipy

    if count != int(count) or total != int(total):
        beta, tail = scipy.stats.beta, 0.5 - confidence / 2
        low = 0.0
        if count:
            low = beta.ppf(tail, count, total - count + 1)
        return float(low), float(
            beta.isf(tail, count + 1, total - count)
        ) if count < total else 1.0
    interval = scipy.stats.binomtest(int(count), int(total)).proportion_ci(
        confidence, method="exact"
    )
    return float(interval.low), float(interval.high)


def share_with_interval(count: float, total: float) -> list[float]:
    """A share, and the ends of its interval; undefined of nothing."""
    if not total:
        return [math.nan] * 3
    return [count / total, *clopper_pearson(count, total)]
