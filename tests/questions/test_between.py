"""Limits between the tests of a matrix, and with more parameter sets of the vehicle model."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.cases import SearchPlan, search_cases
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance import tolerance
from safevar_sumo.questions.tolerance.oracle import Oracle, product_of
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble
from tests.in_process import SLOW, InlinePool, json_of
from tests.questions.conftest import model_of

AHEAD = """
extends = "wear"
name = "ahead"
title = "A pedestrian ahead on a wet road"
[[matrix.tests]]
name = "CPLA"
model = "along"
parameters = { vut_length = 4.7, vut_width = 1.85 }
over = { speed = [50, 60] }
"""
AT_TESTS_ALONE = {
    **{"treadDepth": 5.08, "brakeTorque": 0.84, "brakeResponse": 0.196, "payload": 340},
    **{"payloadCentre": 2.25, "sensorRange": 26.7, "sensorLatency": 0.088},
}
"""Limits of `wear` that hold at its tests; between them, at 59 km/h, a car keeps 0.25 m."""


def test_a_search_between_the_tests_finds_what_no_test_shows(ahead: Study) -> None:
    own = model_of(ahead, keep=0.3)
    oracle = Oracle([own], own.unsafe, between=True)
    vehicle = oracle.vehicle
    end = vehicle.setting(AT_TESTS_ALONE)
    ends = np.minimum(vehicle.original, end), np.maximum(vehicle.original, end)
    space = oracle.space(0, *ends, phases=False)
    vehicles = np.where(default_rng(0).random((512, len(vehicle))) < 0.5, *ends)
    assert oracle(product_of(vehicles, oracle.listed())).min() >= 0
    met = search_cases(
        oracle, space, space.lower[np.newaxis][:0], SearchPlan(5000), default_rng(1)
    )
    assert met.least < 0
    model, setting = oracle.setting(met.unsafe[0])
    speed = dict(zip(model.characteristics.names, setting, strict=True))["speed"]
    assert 50 < speed < 60
    assert speed == round(speed, 2)


def test_an_encounter_between_counts_only_where_the_original_is_safe(
    ahead: Study,
) -> None:
    own = model_of(ahead, keep=0.3)
    worn = own.characteristics.setting({"sensorLatency": 0.4})
    for new_car, counts in ((own.unsafe, True), (Unsafe(keep=99.0), False)):
        oracle = Oracle([own], new_car, between=True)
        left = oracle(oracle.space(0, worn, worn).draw(64, default_rng(0)))
        assert (left < 0).any() == counts


@pytest.mark.parametrize(
    ("over", "between", "said"),
    [
        ("speed = [10, 20, 30, 40]", True, "(A) at 10 to 40 km/h"),
        ("speed = [10, 20, 30, 40]", False, "(A) at 10, 20, 30 and 40 km/h"),
        ('target = ["adult", "child"]', True, "target adult and child"),
    ],
)
def test_a_scope_names_a_range_only_where_it_was_driven(
    ahead: Study, over: str, between: bool, said: str
) -> None:
    text = f'[[matrix.tests]]\nname = "A"\nparameters = {{ test = "CPNA" }}\nover = {{ {over} }}\n'
    if "target" in over:
        text = text.replace("CPNA", "CPFA")
    Path("own.toml").write_text(
        f'extends = "wear"\nname = "own"\ntitle = "Own"\n{text}'
    )
    assert said in scope_of(load_study("own.toml"), between=between)


@SLOW
@pytest.mark.parametrize("name", ["ahead.toml", "rain"])
@pytest.mark.usefixtures("few_simulations")
def test_more_parameter_sets_never_widen_limits_which_hold_between_the_tests(
    ahead: Study, name: str
) -> None:
    names = (
        "treadDepth,sensorLatency"
        if name == "ahead.toml"
        else "tireFric,maxBrakeTorque"
    )
    options = ("--characteristics", names)
    rows = [
        json_of("tolerance", name, *options, "--fits", fits)["tables"]["limits"]["rows"]
        for fits in (("0", "2", "3") if name == "ahead.toml" else ("0", "2", "6", "12"))
    ]
    for fewer, more in pairwise(rows):
        for before, after in zip(fewer, more, strict=True):
            for kind in ("alone", "together"):
                assert before[f"{kind}_low"] <= after[f"{kind}_low"]
                assert before[f"{kind}_high"] >= after[f"{kind}_high"]
    if name == "ahead.toml":
        check_at_whole_speeds(ahead, rows[-1], 3)


def check_at_whole_speeds(study: Study, rows: list[dict[str, Any]], fits: int) -> None:
    """Corners and random cars at whole speeds: what the original survives with a parameter set, all
    of them survive with it.
    """
    members = assemble(study).characteristics
    ends = np.array([members.original, members.original])
    for row in rows:
        ends[:, members.names.index(row["characteristic"])] = (
            row["together_low"],
            row["together_high"],
        )
    points = default_rng(5).random((300, len(members)))
    points[:100] = np.round(points[:100])
    cars = np.vstack([members.original, ends[0] + points * (ends[1] - ends[0])])
    (test,) = study.matrix.tests
    speeds = {"speed": [float(speed) for speed in range(50, 61)]}
    for number, of_set in enumerate(studies_of_sets(study)[:fits]):
        denser = of_set.with_tests([msgspec.structs.replace(test, over=speeds)])
        for result in simulate_all_points(assemble(denser), cars):
            least = 0.0 if number else 0.3
            kept = result.evaluations.f_safe
            assert kept[0] < least or kept.min() >= least, (number, result.point.name)


@SLOW
@pytest.mark.usefixtures("few_simulations")
def test_a_set_in_which_the_original_is_unsafe_is_named_with_its_test(
    ahead: Study,
) -> None:
    text = Path("ahead.toml").read_text()
    spread = '[spread]\n"vehicle.parameters.tyre_friction" = [1.079, 0.2]\n'
    Path("slippery.toml").write_text(f"{text}{spread}".replace('"ahead"', '"slippery"'))
    study = load_study("slippery.toml")
    answer = tolerance.compute(
        study,
        Evaluator(study, InlinePool(), verified=0),
        characteristics=("treadDepth",),
    )
    assert (
        "With the original vehicle itself the car hits a pedestrian ahead"
        in answer.verdict
    )
    assert "(parameter set 1): there no limit is claimed." in answer.verdict
