"""What a study's disagreement costs, worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.reference.fit import original_cost
from safevar_sumo.study import FitTable

PUBLISHED = {"safety_degree": 2.0, "tet": 1.0}
FIT = FitTable(tolerance=0.05, original=0.5, weights={"safety_degree": 1.0, "tet": 0.3})


def cost(safety_degree: float, tet: float) -> float:
    one = np.ones(1)
    original = Evaluations(settings=np.ones((1, 2)), outcome=np.array([Outcome.STOPPED.value]), collision_speed=one * np.nan,
                           metrics={"safety_degree": one * safety_degree, "tet": one * tet}, f_diff=0 * one, f_num_diff=0 * one)
    return original_cost(original, PUBLISHED, FIT)


def test_a_miss_is_squared_within_the_tolerance_and_in_proportion_beyond() -> None:
    assert cost(2.0, 1.0) == 0.0
    assert cost(2.05, 1.0) == pytest.approx(0.5 * 0.5 ** 2 / 2), "half a tolerance; the mean of two metrics counts half"
    assert cost(2.0, 0.95) == pytest.approx(0.5 * 0.3 * 1 / 2), "one tolerance"
    assert cost(2.3, 1.0) == pytest.approx(0.5 * (2 * 3 - 1) / 2), "three tolerances"
    assert cost(20.0, 1.0) == cost(np.nan, 1.0) == pytest.approx(0.5 * (2 * 10 - 1) / 2), "farther than ten is as far as that"


@given(st.floats(0.5, 4.0), st.floats(0.5, 4.0))
def test_who_misses_by_more_pays_no_less(one: float, other: float) -> None:
    near, far = sorted([one, other], key=lambda value: abs(value / 2.0 - 1))
    assert cost(near, 1.0) <= cost(far, 1.0) + 1e-12
