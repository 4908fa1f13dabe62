"""Studies that search vehicle and scenario together: scenes of their encounters, the row's own
original, and what is refused.
"""

from __future__ import annotations

import shutil
import tomllib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.testing import assert_allclose

from safevar_sumo.api.simulation import load_study, simulate
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import explain
from safevar_sumo.questions.tolerance import tolerance
from safevar_sumo.records import RESULT_ROUNDING, FloatArray
from safevar_sumo.results import load_runs
from safevar_sumo.scenarios import SCENARIOS
from safevar_sumo.scenarios.tracks import KMH
from safevar_sumo.study import Study, free_parameters
from safevar_sumo.sumo.matrix import drive_and_score, efficient_batch
from safevar_sumo.sumo.system import System, assemble
from tests.support.in_process import SLOW, InlinePool, searched, verify_everywhere
from tests.support.made_up import assert_same_results, case_of, drawn, system_of
from tests.support.planted import BRAKING, GAP
from tools.manual import ROOT


@pytest.fixture(autouse=True)
def _models(in_tmp: Path) -> None:
    """The planted models in a file beside no other, as all files of a package count as inputs."""
    shutil.copy(ROOT / "tests/support/planted.py", in_tmp)


MARGIN = 4.0
"""Distance that the original vehicle has to keep in the planted study [m]."""


def domain(lower: float, upper: float, original: float | None = None) -> dict[str, Any]:
    return {
        "lower": lower,
        "upper": upper,
        "original": lower if original is None else original,
    }


SPEED, PLACE = domain(30, 60), domain(20, 80, 50)
WEATHER = {
    "road_friction": domain(0.6, 1, 1),
    "visibility": domain(0.5, 1, 1),
    "recognition_delay": domain(0, 0.3),
}
CASES = {
    "walker": (
        "sun",
        {"model": "pedestrian_crossing"},
        {
            "distance": domain(8, 20),
            "walking_speed": domain(1, 2.4),
            "lateral_start": domain(4, 8),
        },
    ),
    "parked": (
        "lgsvl",
        {"model": "lead_vehicle_stopped"},
        {"distance": domain(40, 70)},
    ),
    "child": (
        "wear",
        {"model": "crossing", "parameters": {"test": "CPNCO"}},
        {"speed": SPEED, "impact_location": PLACE, "target_speed": domain(4, 7)},
    ),
    "car": (
        "wear",
        {"model": "crossing", "parameters": {"test": "CCCscp", "heading": 10.0}},
        {"speed": SPEED, "target_speed": domain(20, 50)},
    ),
    "ahead": (
        "wear",
        {"model": "along"},
        {"speed": SPEED, "impact_location": PLACE, "target_speed": domain(3, 8)},
    ),
    "weather": ("wear", {"model": "crossing", "parameters": {"test": "CPFA"}}, {}),
    "mine": ("sun", {"model": "planted:Slope"}, {}),
    "brakes": (
        "wear",
        {"model": "car_to_car", "parameters": {"test": "CCRb"}},
        {
            "speed": SPEED,
            "headway": domain(1, 2),
            "impact_location": PLACE,
            "target_deceleration": domain(3, 6),
        },
    ),
}


@SLOW
@pytest.mark.parametrize("case", CASES)
def test_an_encounter_is_that_of_a_study_with_these_parameters(case: str) -> None:
    """Its scene is one that SUMO has played, and its original vehicle drives there."""
    base, scenario, search = CASES[case]
    system = system_of(
        base,
        matrix=None,
        scenario={**scenario, "over": {**search, **WEATHER}},
        encounters="ranges",
        name=case,
        title=case,
    )
    settings = drawn(system, 4, 3)
    evaluations = drive_and_score(system, settings)
    of_vehicle = system.characteristics.of_vehicle
    for row, setting in enumerate(settings):
        values = system.characteristics.scenario.named(setting[~of_vehicle])
        weather = {name: values.pop(name) for name in WEATHER}
        parameters = {**scenario.get("parameters", {}), **values}
        other = system_of(
            base,
            matrix=None,
            scenario={"model": scenario["model"], "parameters": parameters},
            weather={**msgspec.to_builtins(system.points[0].weather), **weather},
        )
        both = np.stack([setting[of_vehicle], other.characteristics.original])
        alone = drive_and_score(other, both)
        assert alone.outcome[0] == evaluations.outcome[row]
        assert_allclose(
            evaluations.f_safe[row], alone.f_safe[0], rtol=0, atol=RESULT_ROUNDING
        )
        assert_allclose(
            evaluations.metrics["original_safety_degree"][row],
            alone.f_safe[1],
            rtol=0,
            atol=RESULT_ROUNDING,
        )
    verify_everywhere(system, settings)


def test_a_result_depends_neither_on_the_batch_nor_on_the_engine() -> None:
    study = load_study("sun", encounters="ranges")
    system = assemble(study)
    settings = drawn(system, 30, 1)
    together = drive_and_score(system, settings)
    for row in (0, 7, 29):
        alone = drive_and_score(system, settings[[row]])
        assert_same_results(together.take([row]), alone)
    beside = simulate(study, system.characteristics.named(settings[0]))
    assert beside.original.evaluation.f_safe == pytest.approx(
        together.metrics["original_safety_degree"][:1]
    )
    assert efficient_batch(system) > len(settings)
    assert_the_same_in_sumo(system, settings)


def assert_the_same_in_sumo(system: System, settings: FloatArray) -> None:
    recorded, in_sumo = (
        drive_and_score(replace(system, in_sumo=in_sumo), settings)
        for in_sumo in (False, True)
    )
    assert in_sumo.outcome.tolist() == recorded.outcome.tolist()
    assert_allclose(in_sumo.f_safe, recorded.f_safe, rtol=0, atol=RESULT_ROUNDING)


@pytest.mark.parametrize("case", ["walker", "parked"])
def test_sumo_repeats_the_corners_of_the_widest_domains(case: str) -> None:
    """In some, a pedestrian has left the road while other copies go on."""
    base, scenario, _ = CASES[case]
    widest = free_parameters(SCENARIOS[scenario["model"]])
    search = {name: domain(one.lower, one.upper) for name, one in widest.items()}
    system = system_of(
        base,
        matrix=None,
        scenario={**scenario, "over": search},
        encounters="ranges",
    )
    corners = product(
        *((one.lower, one.upper) for one in system.characteristics.scenario)
    )
    settings = np.array(
        [[*system.characteristics.vehicle.original, *corner] for corner in corners]
    )
    assert_the_same_in_sumo(system, settings)


PLANTED = """
name = "planted"
title = "A standing car"
weather = "clear"
step_length = 0.02
encounters = "ranges"
[scenario]
model = "car_to_car"
parameters.headway = 2.0
over.speed = { original = 50, lower = 50, upper = 70 }
over.road_friction = { original = 1, lower = 0.5, upper = 1 }
[vehicle]
model = "planted:Block"
characteristics.brakes = { unit = "-", original = 1, lower = 0.2, upper = 1 }
[ads]
model = "planted:AtGap"
[metrics]
ttc_threshold = 1.5
[search]
algorithms = ["nsga2", "rs", "safe_fuzzer"]
population = 30
evaluations = 150
runs = 1
seed = 1
"""


def planted(**changes: Any) -> Study:
    tables = {**tomllib.loads(PLANTED), **changes}
    tables["scenario"]["margin"] = MARGIN
    return load_study(tables)


@SLOW
def test_the_border_that_nsga_ii_finds_is_that_of_the_formula(tmp_path: Path) -> None:
    """The original stops s = v^2 / (2 a mu) after it brakes and keeps the margin if s <= gap -
    margin; a share b of its brakes collides if s / b > gap. So the least wear that ever collides
    leaves b = 1 - margin / gap of the brakes.
    """
    search = {
        "algorithms": ["nsga2"],
        "population": 40,
        "evaluations": 1200,
        "runs": 1,
        "seed": 1,
    }
    results = load_runs(
        searched(planted(step_length=0.01, search=search), tmp_path / "out")
    )
    solutions = results.solutions
    collisions = solutions[solutions["outcome"] == "collision"]
    assert collisions["brakes"].max() == pytest.approx(1 - MARGIN / GAP, rel=0.01)
    everything = results.evaluations
    stops = (everything["speed"] * KMH) ** 2 / (
        2 * BRAKING * everything["road_friction"]
    )
    ratio = stops / everything["brakes"] / GAP
    collided = everything["outcome"] == "collision"
    assert ratio[collided].min() > 0.99
    assert ratio[~collided].max() < 1.01
    degrees = everything["original_safety_degree"]
    assert_allclose(degrees[degrees > 0], (GAP - stops)[degrees > 0], atol=0.01 * GAP)


@SLOW
def test_a_setting_whose_original_collides_too_is_never_a_solution(
    tmp_path: Path,
) -> None:
    """In half of the encounters here the original collides; all algorithms simulate them and report
    none.
    """
    over = {"speed": domain(50, 90), "road_friction": domain(0.5, 1, 1)}
    study = planted(
        scenario={"model": "car_to_car", "parameters": {"headway": 2.0}, "over": over}
    )
    results = load_runs(searched(study, tmp_path / "out"))
    for algorithm, rows in results.evaluations.groupby("algorithm"):
        assert (rows["original_safety_degree"] < MARGIN).mean() > 0.1, algorithm
    assert (results.solutions["original_safety_degree"] >= MARGIN).all()
    assert set(results.solutions["algorithm"]) == {"nsga2", "rs", "safe_fuzzer"}
    assert (results.solutions["outcome"] == "collision").any()


@SLOW
@pytest.mark.usefixtures("coarse", "few_simulations")
def test_tolerance_holds_in_all_encounters_and_ends_where_the_formula_does() -> None:
    """The encounters in which the original just keeps its margin are the hardest: 1 - margin / gap
    of the brakes.
    """
    study = planted()
    answer = tolerance.compute(study, Evaluator(study, InlinePool()), fits=0)
    (limit,) = answer.tables["limits"].to_dict("records")
    border = 1 - (MARGIN - 0.1) / GAP  # it keeps 0.1 m
    assert limit["together_low"] == pytest.approx(border, rel=0.01)
    assert limit["alone_low"] == pytest.approx(border, rel=0.02)
    assert answer.numbers["failures"] == 0


@SLOW
def test_a_cause_is_wear_in_its_encounter_and_says_whether_the_original_encounter_shows_it() -> (
    None
):
    study = planted()
    evaluator = Evaluator(study, InlinePool())
    found = evaluator.evaluate(evaluator.feasible_settings(256), "solutions")
    case = case_of(study, evaluator.evaluate_original(), found.take(found.valid))
    answer = explain.compute(case, evaluator, quick=True, top=2)
    assert len(answer.tables["causes"])
    for cause in answer.tables["causes"].to_dict("records"):
        assert [*cause["changes"]] == ["brakes"]
        speed = cause["encounter"]["speed"] * KMH
        stop = speed**2 / (2 * BRAKING * cause["encounter"]["road_friction"])
        assert stop <= GAP - MARGIN + 0.5, "the original is safe there"
        assert cause["boundary"]["brakes"] == pytest.approx(stop / GAP, rel=0.03)
    at_original = (50 * KMH) ** 2 / (2 * BRAKING) / GAP
    assert [*answer.tables["causes"]["elsewhere"]] == [
        changes["brakes"] < at_original
        for changes in answer.tables["causes"]["changes"]
    ]
