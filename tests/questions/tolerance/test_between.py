"""Limits between the tests of a matrix, and with more parameter sets of the vehicle model."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.part import scope_of
from safevar_sumo.questions.tolerance import tolerance
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, InlinePool, json_of, write


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
    in_tmp: Path, over: str, between: bool, said: str
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
    ends = [
        members.setting({row["characteristic"]: row[end] for row in limits["rows"]})
        for end in ("together_low", "together_high")
    ]
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
