"""Random numbers, points that cover a domain evenly, and confidence intervals of shares."""

from __future__ import annotations

import math
from enum import IntEnum

from numpy.random import Generator, default_rng

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Interval as Interval  # noqa: PLC0414 - for other modules
from safevar_sumo.vehicles import CharacteristicSet

CONFIDENCE = 0.95
"""Confidence level of the intervals of shares, unless an option sets another level."""


class Stream(IntEnum):
    """The uses of random numbers. Each use has a stream of its own, so that its numbers do not
    depend on other uses.

    Results depend on the numbers of the streams: a new use takes a new number.
    """

    # Vehicles within joint limits, for the upper confidence bound.
    CONFIDENCE_BOUND = 1
    # Steps from the largest safe box that is known to larger ones.
    LARGER_BOXES = 2
    # Searches for counterexamples to joint limits.
    JOINT_LIMITS = 4
    # Searches for counterexamples to limits alone.
    LIMITS_ALONE = 6
    # Vehicles within the promised wear, for the bound of a repair.
    REPAIRED_BOUND = 7
    # Searches for the safe value that is nearest to a specified limit that does not hold.
    NEAREST_LIMIT = 8
    # Searches for counterexamples to limits in the ranges of a study.
    WIDER_SCOPE = 9
    # Searches for counterexamples to joint limits with a longer side.
    EXTENSION = 10
    # Searches for counterexamples to specified limits.
    SPECIFIED_BETWEEN = 11
    # Searches that a proposed box of joint limits must pass.
    VALIDATION = 15
    # Corners with which the test of joint limits begins.
    FIRST_CORNERS = 17
    # Search for counterexamples to the speed of a car.
    PERMIT = 18

    def generator(self, seed: int, *counts: int) -> Generator:
        """The generator of random numbers for this use. It depends on the seed of the study's
        search and on `counts`, which number the draws.
        """
        return default_rng((seed, self, *counts))


def sobol_points(number: int, dimensions: int, seed: int) -> FloatArray:
    """Scrambled Sobol points in the unit cube, shape (number, dimensions). They cover the cube most
    evenly if `number` is a power of two.
    """
    # Loading takes longer than a simulation.
    import scipy

    sequence = scipy.stats.qmc.Sobol(dimensions, rng=default_rng(seed))
    points: FloatArray = sequence.random_base2(math.ceil(math.log2(number)))
    return points[:number]


def sobol_settings(characteristics: CharacteristicSet, number: int) -> FloatArray:
    """Settings that cover the whole domain evenly, shape (number, n); some may be infeasible."""
    lower = characteristics.lower
    upper = characteristics.upper
    return lower + sobol_points(number, len(characteristics), 0) * (upper - lower)


def clopper_pearson(
    count: float, total: float, confidence: float = CONFIDENCE
) -> Interval:
    """The exact confidence interval (Clopper and Pearson) of the share `count` / `total`. If
    `count` or `total` is no whole number, the ends are quantiles of the same beta distributions.
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
    """The share `count` / `total`, and the ends of its interval; all NaN if `total` is 0."""
    if not total:
        return [math.nan] * 3
    return [count / total, *clopper_pearson(count, total)]
