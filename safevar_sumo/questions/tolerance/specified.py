"""Limits that the user specifies, tested in every parameter set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from safevar_sumo.questions.between import MovingTest
from safevar_sumo.questions.box import MAX_CORNERS, Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.validation import KNOWN_BETWEEN
from safevar_sumo.records import FloatArray

SPECIFICATION_POINTS = 256
"""Number of Sobol points, and of corners, at which specified limits are tested, all others as in
the original.
"""


def broken_specification(
    specified: Box, models: Sequence[Model], tests: Mapping[int, Sequence[MovingTest]]
) -> dict[int, tuple[Model, FloatArray]]:
    """The worst setting of specified limits in each parameter set in which they are unsafe, and the
    model at the points where it is: those of the study, or between those of its `tests`.
    """
    stage = "specified limits with each parameter set"
    seed = models[0].evaluator.seed
    scaled = models[0].evaluator.scaled
    corners = specified.corners(seed, 0)[:MAX_CORNERS]
    corners = corners[: scaled(len(corners))]
    spread = specified.spread_and_corners(scaled(SPECIFICATION_POINTS), seed)
    settings = np.unique(np.concatenate([corners, spread]), axis=0)
    broken = dict[int, tuple[Model, FloatArray]]()
    for model in models:
        if _keeps_its_margin(specified, model):
            continue
        robustness = model.robustness(settings, stage)
        if robustness.min() < 0:
            broken[model.fit] = model, settings[np.argmin(robustness)]
            continue
        worst = settings[np.argsort(robustness, kind="stable")[:KNOWN_BETWEEN]]
        rng = Stream.SPECIFIED_BETWEEN.generator(seed, model.fit)
        for test in tests[model.fit]:
            between = test.spread(worst, rng)
            robustness = test.robustness(between, stage)
            if robustness.min() < 0:
                at_encounter, vehicles = test.as_tests(between[[np.argmin(robustness)]])
                broken[model.fit] = at_encounter, vehicles[0]
                break
    return broken


def _keeps_its_margin(specified: Box, model: Model) -> bool:
    """Whether specified limits are the original vehicle, in a study whose encounters count where
    that keeps a margin, and nothing but less than it would be unsafe: then no encounter that counts
    can break them.
    """
    members = model.characteristics
    is_original = (specified.lower == members.original) & (specified.upper == members.original)
    if not len(members.scenario) or not is_original[members.of_vehicle].all():
        return False
    margin = model.evaluator.study.scenario.margin
    return model.unsafe.is_collision and margin is not None and model.unsafe.keep <= margin
