"""Shares, bands and corners against closed forms."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from safevar_sumo.questions.model_spread import band_of, error_distance, prediction_band
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.study import SAFETY_DEGREE
from tests.support.made_up_studies import made_up_study

pytestmark = pytest.mark.usefixtures("made_up_studies")


@pytest.mark.parametrize("total", [3, 2.5])
def test_an_exact_interval_of_none_one_and_all_has_a_closed_form(total: float) -> None:
    """Beta distributions with a parameter of 1 are powers; 2.5 is a mean over sets."""
    tail, root = 0.05, 1 / total
    none, all_of_them = (clopper_pearson(count, total, 0.9) for count in (0, total))
    assert none == pytest.approx((0, 1 - tail**root))
    assert all_of_them == pytest.approx((tail**root, 1))
    assert clopper_pearson(1, total, 0.9)[0] == pytest.approx(1 - (1 - tail) ** root)
    most = clopper_pearson(total - 1, total, 0.9)[1]
    assert most == pytest.approx((1 - tail) ** root)


def test_a_band_holds_nine_tenths_of_the_sets_and_of_the_repeats() -> None:
    """And the model's error, which counts the distance in domains, and 0.3 of one at least."""
    degrees = np.column_stack([np.linspace(0, 1, 101), np.full(101, np.nan)])
    lower, upper = prediction_band(degrees, 0.1)
    assert (lower[0], upper[0]) == pytest.approx((0.05 - 0.1645, 0.95 + 0.1645))
    assert np.isnan([lower[1], upper[1]]).all()
    errors = {
        "repeatability": {SAFETY_DEGREE: 0.1},
        "model_error": {SAFETY_DEGREE: 2.0},
    }
    study = replace(made_up_study(2), **errors)
    settings = np.array([[8.0, 1.0], [5.0, 6.0]])  # by 3 and 4 of 10, and by 1
    assert error_distance(study, settings) == pytest.approx([0.5, 0.3])
    sets: Any = [SimpleNamespace(settings=settings, f_safe=row) for row in degrees]
    low, high = band_of(study, sets)
    assert (low[0], high[0]) == pytest.approx((lower[0] - 1, upper[0] + 1))
