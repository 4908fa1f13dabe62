"""Printed counterexamples fail as printed, and values up to which a claim holds are rounded."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import describe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS
from safevar_sumo.questions.models import judges_of
from safevar_sumo.questions.reach import falsify_limits, reach, rounded_towards
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic, region_of
from tests.in_process import SLOW, InlinePool, json_of, numbers_of, refused
from tests.questions.conftest import made_up_model, made_up_study, nowhere


def test_a_counterexample_that_is_safe_as_rounded_gets_more_digits_or_is_left_out() -> None:
    """Unsafe are values of the first from 7.13 to 7.1302 without the former: with up to three
    digits none is.
    """

    def sliver(rows: FloatArray) -> BoolArray:
        return (rows[:, 0] >= 7.13) & (rows[:, 0] <= 7.1302) & (rows[:, 0] != 7.13)

    model = made_up_model(2, sliver)
    found = describe(model, {"a": np.array([7.13005, 5.0]), "b": np.array([7.5, 5.0])})
    assert [*found] == ["a"], "a setting that is safe is not described"
    assert sliver(found["a"].setting[np.newaxis])[0]


def test_a_described_setting_stays_within_the_limits_that_it_breaks() -> None:
    study = made_up_study(2)
    model = made_up_model(2, lambda rows: rows[:, 0] > 7)
    within = Box(region_of(study), np.array([5.0, 5.0]), np.array([7.1234, 5.0]))
    found = describe(model, {"": np.array([7.12339, 5.0])}, within)
    assert within.holds(found[""].setting[np.newaxis])[0]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("edge", [1.0, 2.77, 4.99, 0.0, -0.1])
def test_a_reach_ends_just_before_a_planted_boundary_at_its_start_or_nowhere(
    edge: float, side: int
) -> None:
    """Unsafe is a beyond `edge` from the original, on either side, where b is within 0.4 of 8: a
    narrow pocket.
    """

    def pocket(rows: FloatArray) -> BoolArray:
        return (side * (rows[:, 0] - 5) > edge) & (np.abs(rows[:, 1] - 8) < 0.4)

    model = made_up_model(2, pocket)
    ends = np.sort([[5.0, 0.0], [5.0 + 5 * side, 10.0]], axis=0)
    judges = judges_of([model], "reach")
    found = reach(
        Box(model.evaluator.region, *ends), (int(side > 0), 0), 5.0, judges, LEAST_SIMULATIONS, (1,)
    )
    if edge < 0:
        assert found is None
        return
    assert edge - 0.11 <= side * (found - 5) <= edge
    assert edge == 0 or model.evaluator.simulated >= LEAST_SIMULATIONS


def test_a_falsification_names_the_model_that_fails() -> None:
    models = [made_up_model(2, nowhere), made_up_model(2, lambda rows: rows[:, 1] > 9.5, 1)]
    box = Box(models[0].evaluator.region, np.zeros(2), np.full(2, 10.0))
    found = falsify_limits(box, judges_of(models, "falsification"), 2000, (1,))
    assert [*found.failures] == [1]
    assert (found.failures[1][:, 1] > 9.5).all()


@pytest.mark.parametrize(
    ("start", "value", "unit", "expected"),
    [
        (10, 48.97, "km/h", 48.9),
        (10, 48.9, "km/h", 48.9),
        (0, 0.127, "s", 0.12),
        (0.5, 0.121, "s", 0.13),
        (0.125, 0.127, "s", 0.125),
    ],
)
def test_values_are_rounded_towards_the_start_as_they_are_printed(
    start: float, value: float, unit: str, expected: float
) -> None:
    item = SimpleNamespace(digits=2, unit=unit)
    assert rounded_towards(start, value, cast(Characteristic, item)) == expected


def test_a_margin_that_the_original_does_not_keep_ends_the_question() -> None:
    study = load_study("wear")
    evaluator = Evaluator(study, InlinePool(), verified=0)
    answer = tolerance.compute(study, evaluator, margin=30)
    assert evaluator.simulated <= 2
    assert answer.verdict.startswith(
        "The original vehicle itself keeps 0.88 m of clearance, less than 30"
    )
    assert answer.numbers["kept"] is False


@SLOW
def test_a_failure_between_tests_of_any_set_is_simulated_by_its_command() -> None:
    car = ["--set", "treadDepth=2", "--set", "brakeTorque=0.55", "--set", "payload=500"]
    asked = json_of("permit", "wear", *car, "--others", "new")
    failing = [row for row in asked["tables"]["sets"]["rows"] if row["simulate"]]
    assert len({row["fit"] for row in failing}) > 5
    for row in failing:
        assert numbers_of(row["simulate"])["f_safe"] < 0.3, row["simulate"]


@SLOW
def test_an_axis_of_the_matrix_is_set_where_tests_have_it() -> None:
    point = ("--point", "CPFA, speed 40, wet")
    at_test = json_of("simulate", "wear", "--set", "speed=40", *point)
    assert at_test["numbers"] == json_of("simulate", "wear", *point)["numbers"]
    both = json_of("simulate", "wear", "--set", "speed=33", "--set", "impact_location=40")
    assert [row["point"] for row in both["tables"]["points"]["rows"]] == ["CPNA, wet"]
    refused("simulate", "wear", "--set", "speed=70", message=("speed = 70.0", "[10, 60] km/h"))
    within = json_of("simulate", "fmvss127", "--set", "speed=65")["tables"]["points"]["rows"]
    tests = {row["point"].partition(",")[0] for row in within}
    assert {"stopped lead vehicle", "slower lead vehicle"} < tests
    assert "adult crosses from the right" not in tests, "its range ends at 60 km/h"
    both = ("--set", "speed=50", "--set", "headway=1")
    refused("simulate", "fmvss127", *both, message=("no test has headway and speed together",))
    refused("simulate", "wear", "--fit", "12", message=("--fit: 12", "a number up to 11"))
