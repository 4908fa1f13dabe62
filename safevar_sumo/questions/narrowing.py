"""A judge that spares points of a matrix at which no vehicle was worst."""

from __future__ import annotations

import math

import numpy as np

from safevar_sumo.questions.models import Model
from safevar_sumo.records import FloatArray

LEAST_SHARE = 1 / 8
"""Share of the settings of a call that meet all points, as they leave least at the points met so
far.
"""
OTHERS = 16
"""Of all others, each setting with this number meets all points, too."""


class NarrowedJudge:
    """Judges settings in a model: the first ones at all points of its matrix; later ones at those
    points that were worst for some setting, and at all points those that then leave least, and a
    part of the others. Without a matrix, or where encounters are ranges, all meet
    everything.

    Attributes
    ----------
    model
        The model; its matrix may gain points.
    at_all_points
        Number of settings that met all points.
    """

    def __init__(self, model: Model, stage: str) -> None:
        self.at_all_points = 0
        self.model = model
        self._stage = stage
        self._worst = set[int]()
        self._may_narrow = not len(model.evaluator.characteristics.scenario)

    def __call__(self, settings: FloatArray) -> FloatArray:
        """What each of M settings leaves, shape (M,), see `Model.robustness`; one that did not meet
        all points may leave less.
        """
        # Two calls cost more than one if the worst points are most of them.
        is_narrow = 2 * len(self._worst) < len(self.model.evaluator.system.points)
        if not self._worst or not is_narrow:
            return self._judge_at_all_points(settings)
        narrowed = self.model._replace(points=tuple(sorted(self._worst)))
        robustness = narrowed.robustness(settings, self._stage)

        # Those that leave least, and some others, meet all points.
        order = np.argsort(robustness, kind="stable")
        number = math.ceil(LEAST_SHARE * len(order))
        chosen = np.concatenate([order[:number], order[number::OTHERS]])
        robustness[chosen] = self._judge_at_all_points(settings[chosen])
        return robustness

    def _judge_at_all_points(self, settings: FloatArray) -> FloatArray:
        """What settings leave at all points; the worst ones are known from now on."""
        self.at_all_points += len(settings)
        is_feasible = self.model.evaluator.region.feasible(settings)
        evaluations = self.model.evaluate(settings, self._stage)
        worst = evaluations.worst_points
        if self._may_narrow and worst is not None:
            self._worst |= {*worst[is_feasible & evaluations.valid].tolist()}
        return np.where(is_feasible, self.model.robustness_by(evaluations), np.inf)
