"""Limits between the tests of a matrix, and with more parameter sets of the vehicle model."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.random import default_rng

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.cases import SearchPlan, search_cases
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import scope_of
from safevar_sumo.questions.tolerance import tolerance
from safevar_sumo.questions.tolerance.oracle import Exhausted, Oracle, product_of
from safevar_sumo.study import Constraint, Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble
from tests.in_process import SLOW, InlinePool, json_of, write
from tests.questions.conftest import Plant, made_up_study, model_of

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


def test_cases_lie_in_worlds_with_a_phase_and_a_place_on_each_axis(
    ahead: Study,
) -> None:
    """One test at 50 and 60 km/h, in two parameter sets."""
    own = model_of(ahead, keep=0.3)
    oracle = Oracle([own, own._replace(fit=3)], own.unsafe, between=True)
    vehicle = oracle.vehicle
    n = len(vehicle)
    space = oracle.space(3, vehicle.lower, vehicle.upper)
    assert space.lower.tolist() == [*vehicle.lower, 1, 0, 0]
    assert space.upper.tolist() == [*vehicle.upper, np.nextafter(2, 0), 1, 1]
    at_start = oracle.space(0, vehicle.lower, vehicle.upper, phases=False)
    assert at_start.upper[n:].tolist() == [np.nextafter(1, 0), 0, 1]
    assert oracle.listed().tolist() == [[0, 0, 0], [0, 0, 1]]
    assert oracle.hardest(1).tolist() == [[0, 0, 0]], "at 50 km/h"
    model, setting = oracle.setting(np.r_[vehicle.original, 1.9, 0.25, 0.4])
    assert model.fit == 3
    values = dict(zip(model.characteristics.names, setting.tolist(), strict=True))
    assert (values["speed"], values["phase"]) == (54, 0.25)
    assert setting[:n].tolist() == vehicle.original.tolist()


def test_what_cannot_be_simulated_or_is_infeasible_leaves_everything() -> None:
    """a above 9 fails, a below 1 violates a constraint, and b above 7 collides."""
    study = replace(
        made_up_study(2), constraints=(Constraint(sum={"a": 1.0}, at_least=1.0),)
    )
    plant = Plant(
        study,
        lambda rows: rows[:, 1] > 7,
        lambda rows: rows[:, 1],
        lambda rows: rows[:, 0] > 9,
    )
    evaluator = Evaluator(study, plant)
    evaluator.account.limit = 12
    oracle = Oracle([Model(0, evaluator, Unsafe(keep=0.5))], Unsafe(), between=False)
    (encounter,) = oracle.listed()
    vehicles = np.array([[9.5, 8.0], [0.5, 8.0], [5.0, 8.0], [5.0, 0.25], [5.0, 3.0]])
    cases = product_of(vehicles, encounter[np.newaxis])
    assert oracle(cases).tolist() == [np.inf, np.inf, -1.5, -0.25, 2.5]
    assert oracle.available == 10 - 4, "those that satisfy the constraint"
    assert oracle(cases[:3], 7).tolist() == [7, np.inf, -1.5]
    assert np.isnan(oracle(cases[:1], np.nan)).all()
    assert oracle.available == 3
    with pytest.raises(Exhausted):
        oracle(cases[:4])
    assert len(oracle(cases[2:5])) == 3, "as many as are left"
    drawn = oracle.feasible(lambda count: vehicles[np.arange(count) % 2], 8)
    assert {*drawn[:, 0].tolist()} == {9.5}


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
        (
            "speed = [10, 20, 30, 40]",
            True,
            "the test A (scenario crossing) at 10 to 40 km/h",
        ),
        (
            "speed = [10, 20, 30, 40]",
            False,
            "A (scenario crossing) at 10, 20, 30 and 40 km/h",
        ),
        ('target = ["adult", "child"]', True, "target adult and child"),
    ],
)
def test_a_scope_names_a_range_only_where_it_was_driven(
    ahead: Study, over: str, between: bool, said: str
) -> None:
    text = f'[[matrix.tests]]\nname = "A"\nparameters = {{ test = "CPNA" }}\nover = {{ {over} }}\n'
    if "target" in over:
        text = text.replace("CPNA", "CPFA")
    write("own.toml", f'extends = "wear"\nname = "own"\ntitle = "Own"\n{text}')
    assert said in scope_of(load_study("own.toml"), between=between)


@SLOW
@pytest.mark.usefixtures("few_simulations")
def test_limits_hold_at_whole_speeds_between_the_tests(ahead: Study) -> None:
    """Corners and random cars: what the original survives with a parameter set, all of them survive
    with it.
    """
    options = "--characteristics treadDepth,sensorLatency --fits 3"
    limits = json_of(f"tolerance ahead.toml {options}")["tables"]["limits"]
    members = assemble(ahead).characteristics
    ends = np.array([members.original, members.original])
    for row in limits["rows"]:
        column = members.names.index(row["characteristic"])
        ends[:, column] = row["together_low"], row["together_high"]
    points = default_rng(5).random((300, len(members)))
    points[:100] = np.round(points[:100])
    cars = np.vstack([members.original, ends[0] + points * (ends[1] - ends[0])])
    (test,) = ahead.matrix.tests
    speeds = {"speed": [float(speed) for speed in range(50, 61)]}
    for number, of_set in enumerate(studies_of_sets(ahead)[:3]):
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
    write("slippery.toml", f"{text}{spread}".replace('"ahead"', '"slippery"'))
    study = load_study("slippery.toml")
    answer = tolerance.compute(
        study,
        Evaluator(study, InlinePool(), verified=0),
        characteristics=("treadDepth",),
    )
    assert (
        "the original vehicle fails with this set: the vehicle hits a pedestrian ahead"
        in answer.verdict
    )
