"""Printed counterexamples fail as printed."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import describe
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import region_of
from tests.support.in_process import (
    SLOW,
    json_of,
    numbers_of,
    rows_of,
)
from tests.support.made_up_studies import made_up_model, made_up_study

pytestmark = pytest.mark.usefixtures("made_up_studies")


def test_a_counterexample_that_is_safe_as_rounded_gets_more_digits_or_is_left_out() -> (
    None
):
    """Unsafe are values of the first from 7.13 to 7.1302 without the former: with up to three
    digits none is.
    """

    def sliver(rows: FloatArray) -> BoolArray:
        return (rows[:, 0] >= 7.13) & (rows[:, 0] <= 7.1302) & (rows[:, 0] != 7.13)

    found = describe(
        made_up_model(2, sliver),
        [np.array([7.13005, 5.0]), np.array([7.5, 5.0])],
    )
    assert [*found] == [0], "a setting that is safe is not described"
    assert sliver(np.array([[*found[0].failing_values.values()]]))[0]


def test_a_described_setting_stays_within_the_limits_that_it_breaks() -> None:
    study = made_up_study(2)
    model = made_up_model(2, lambda rows: rows[:, 0] > 7)
    within = Box(region_of(study), np.array([5.0, 5.0]), np.array([7.1234, 5.0]))
    found = describe(model, [np.array([7.12339, 5.0])], within)
    assert within.holds(np.array([[*found[0].failing_values.values()]]))[0]


@SLOW
def test_an_axis_of_the_matrix_is_set_where_tests_have_it() -> None:
    at_test = "simulate wear --point 'CPFA, speed 40, wet'"
    assert numbers_of(f"{at_test} --set speed=40") == numbers_of(at_test)
    both = json_of("simulate wear --set speed=33 --set impact_location=40")
    assert [row["point"] for row in rows_of(both, "points")] == ["CPNA, wet"]
    within = rows_of(json_of("simulate fmvss127 --set speed=65"), "points")
    tests = {row["point"].partition(",")[0] for row in within}
    assert {"stopped lead vehicle", "slower lead vehicle"} < tests
    assert "adult crosses from the right" not in tests, "its range ends at 60 km/h"
