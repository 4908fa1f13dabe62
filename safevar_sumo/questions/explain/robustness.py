"""Tests whether a failure is robust: whether vehicles with nearly the same values (neighbours) are
unsafe, too, also with other time steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import CharacteristicSet

NEIGHBOURS = "check similar vehicles"
"""The phase of progress in which neighbours are simulated."""
NEIGHBOUR_COUNT = 64
"""Number of neighbours of a setting that are simulated with each time step."""
LEAST_NEIGHBOURS = 8
"""Number of neighbours in a rough answer. If so few simulations are allowed that there are fewer
neighbours, the share of unsafe neighbours is unknown.
"""
STEP_FACTORS: Sequence[float] = (1.0, 0.5, 2.0)
"""Factors by which the study's time step is multiplied; the step itself comes first."""
MIN_ROBUST_SHARE = 0.8
"""Least share of unsafe neighbours of a robust failure. With a smaller share it is borderline."""


def draw_neighbours(
    characteristics: CharacteristicSet, settings: FloatArray, seed: int, count: int
) -> FloatArray:
    """The neighbours of M settings, shape (M, n): `count` neighbours of the first setting, then of
    the second, and so on, shape (M * count, n).

    A neighbour differs from its setting by at most the filter's threshold in each value.
    """
    n = len(characteristics)
    shares = np.random.default_rng(seed).uniform(-1, 1, (count, n))
    neighbours = settings[:, np.newaxis] + shares * characteristics.threshold
    within_domain = np.clip(neighbours, characteristics.lower, characteristics.upper)
    return within_domain.reshape(-1, n)


def robust_shares(
    evaluator: Evaluator, settings: FloatArray, unsafe: Unsafe
) -> FloatArray:
    """The unsafe shares of the neighbours of M settings, shape (M, n): the means over the study's
    time step times each of `STEP_FACTORS`, shape (M,). With few simulations only the study's step
    is used. Shares are NaN if there would be too few neighbours.

    Neighbours are simulated without the filter. A neighbour without a valid simulation does not
    count.
    """
    count, factors = NEIGHBOUR_COUNT, STEP_FACTORS
    if evaluator.budget.effort < 1:
        count, factors = LEAST_NEIGHBOURS, factors[:1]
    elif evaluator.settings_left is not None:
        count = min(count, evaluator.settings_left // (6 * max(len(settings), 1)))
        factors = factors[:1]
    if count < LEAST_NEIGHBOURS:
        return np.full(len(settings), np.nan)
    neighbours = draw_neighbours(
        evaluator.characteristics, settings, evaluator.seed, count
    )
    shares = []
    step = evaluator.system.step
    if evaluator.system.mover.has_own_step:
        factors = (1.0,)

    step_evaluator = evaluator
    with evaluator.phases.stage(NEIGHBOURS, len(neighbours) * len(factors)):
        for factor in factors:
            if factor != 1:
                step_evaluator = evaluator.with_step(step * factor)
            evaluations = step_evaluator.evaluate(neighbours, NEIGHBOURS)
            is_valid = evaluations.valid.reshape(-1, count)
            unsafe_shares = unsafe.runs(evaluations).mean(axis=0).reshape(-1, count)
            failing = (unsafe_shares * is_valid).sum(axis=1)
            shares.append(failing / np.maximum(is_valid.sum(axis=1), 1))
    return np.asarray(np.mean(shares, axis=0))
