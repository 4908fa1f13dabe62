"""The search for a box moves its sides against regions that are known."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.tolerance.search import BoxSearch
from safevar_sumo.records import BoolArray, FloatArray
from tests.questions.conftest import Plant, made_up_study


@pytest.mark.parametrize("gap", [0.0, 0.1, 0.4])
def test_a_box_is_not_widened_through_what_fails_beside_it(gap: float) -> None:
    """However far it keeps off known failures: those that the widening finds lie within that distance."""

    def wall(rows: FloatArray) -> BoolArray:
        return np.asarray((rows[:, 0] > 7) & (rows[:, 1] > 4))

    study = made_up_study(2)
    model = Model(0, Evaluator(study, Plant(study, wall)), Unsafe())
    search = BoxSearch(model, [0, 1], {}, np.zeros((0, 2)))
    search.corners.append(np.array([1.0, 1.0]))
    search.gap = gap
    sides = search.widened(np.ones((2, 2)))
    assert not len(search.unsafe_inside(sides))
    assert sides[1, 0] == pytest.approx(2.0, abs=0.2), "up to the wall"
    assert sides[:, 1].tolist() == [5.0, 5.0]
