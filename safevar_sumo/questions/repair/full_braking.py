"""Which vehicles full braking at the first possible moment keeps safe: of many points, the hardest
are asked first.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.campaign.evaluation import Selection
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import BoolArray, Evaluations, FloatArray

HARDEST = (2, 8)
"""Numbers of the hardest points that are asked first, and then; all others follow."""
LEAST_SETTINGS = 128
"""Number of settings from which on the points are asked one after another: fewer cost no more than
the steps of a simulation.
"""
STAGE = "full braking"


class FullBraking:
    """Full braking at the first possible moment, which must not be unsafe at any point.

    Who is not safe at one point need not drive at the others; so those points come first at which
    most others were not.
    """

    def __init__(self, evaluator: Evaluator, unsafe: Unsafe) -> None:
        self.evaluator = evaluator
        self._unsafe = unsafe
        self._failures = np.zeros(len(evaluator.system.points))
        """How many vehicles were least safe, and not safe, at each point."""

    def saves(self, settings: FloatArray) -> BoolArray:
        """Which settings are safe, shape (M,)."""
        has_encounters = len(self.evaluator.characteristics.scenario) > 0
        if (
            has_encounters
            or len(self._failures) <= HARDEST[-1]
            or len(settings) < LEAST_SETTINGS
        ):
            return (
                robustness_of(self.evaluator.evaluate(settings, STAGE), self._unsafe)
                >= 0
            )
        is_safe = self.evaluator.region.feasible(settings)
        for points in np.split(np.argsort(-self._failures, kind="stable"), HARDEST):
            rows = np.flatnonzero(is_safe)
            selection = Selection(points=tuple(points.tolist()))
            evaluations = self.evaluator.evaluate_selection(
                settings[rows], selection, STAGE
            )
            is_safe[rows] = robustness_of(evaluations, self._unsafe) >= 0
            if evaluations.worst_points is not None:
                np.add.at(
                    self._failures, points[evaluations.worst_points[~is_safe[rows]]], 1
                )
        return is_safe


def robustness_of(evaluations: Evaluations, unsafe: Unsafe) -> FloatArray:
    """What evaluations leave to a limit, shape (M,): infinite without a conflict, minus infinity if
    invalid.
    """
    return np.where(evaluations.valid, unsafe.robustness(evaluations), -np.inf)
