"""Preventability: the driving system's failure if a competent driver avoids it in the same vehicle; the vehicle's if nobody does."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import scipy

from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain.braking_comparison import sentence
from safevar_sumo.analysis.explain.compute import PointComparison, compare_at_points
from safevar_sumo.analysis.explain.paragraph import _avoided_shares_in_words
from safevar_sumo.analysis.explain.summary import summarise_failures
from safevar_sumo.analysis.preventability import (
    Preventability,
    PreventableBy,
    approach_parameters,
    assess_preventability,
    classify_collisions,
)
from safevar_sumo.analysis.words import points_in_words
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray
from safevar_sumo.results import solutions_frame
from safevar_sumo.study import ModelTable, load_study
from safevar_sumo.sumo.matrix import evaluate, simulate
from safevar_sumo.sumo.system import System, assemble
from tests.in_process import InlinePool

STUDY = load_study("euro_ncap_pedestrian")
BLIND = ModelTable(model="aeb", parameters={"reach": 3.0})
NAMES = list(STUDY.vehicle.characteristics)
ORIGINAL = np.array([one.original for one in STUDY.vehicle.characteristics.values()])


def evaluator(**parameters: object) -> Evaluator:
    """A short-sighted driving system in one scenario."""
    scenario = ModelTable(model="crossing", parameters=parameters)
    return Evaluator(msgspec.structs.replace(STUDY, matrix=None, ads=BLIND, scenario=scenario), InlinePool())


def vehicle(brakes: float = 1.0, max_rpm: float = 1.0) -> FloatArray:
    """The original vehicle with these shares of its brakes (and engine drag) and of its maximum speed of the engine."""
    factors = {"maxBrakeTorque": brakes, "dampRateZeroT_CE": brakes, "max_rpm": max_rpm}
    return ORIGINAL * [factors.get(name, 1.0) for name in NAMES]


def test_shares_are_told_with_their_counts() -> None:
    counts = {PreventableBy.COMPETENT_DRIVER: 5, PreventableBy.NOBODY: 2}
    sentences = [_avoided_shares_in_words(Preventability(counts=counts, collisions=number))[0] for number in (7, 300)]
    end = "a competent driver avoids 71 % (5 of 7) and 29 % (2 of 7) are physically unavoidable."
    assert sentences == [f"In the same vehicle, of the collisions, {end}",
                         f"In the same vehicle, of 7 collisions, drawn at random from 300, {end}"]
    assert str(Preventability(counts=counts, collisions=7)).startswith("Preventability in the same vehicle (7 collisions): 71 % ")


@pytest.mark.slow
def test_a_competent_driver_avoids_what_a_short_sighted_system_does_not_and_nobody_stops_without_brakes() -> None:
    both = np.stack([vehicle(), vehicle(brakes=0.1)])
    assert classify_collisions(evaluator(test="CPFA", speed=30), both) == [PreventableBy.COMPETENT_DRIVER, PreventableBy.NOBODY]


@pytest.mark.slow
def test_a_child_that_comes_out_late_is_avoided_by_full_braking_alone() -> None:
    assert classify_collisions(evaluator(test="CPNCO", speed=40), vehicle()[np.newaxis]) == [PreventableBy.FULL_BRAKING]


@pytest.mark.slow
def test_shares_are_those_of_all_collisions_and_a_sample_is_random() -> None:
    """Of 60 collisions, the 40 of the lowest engine speeds are the brakeless ones: those that come first when settings are sorted."""
    collisions = np.stack([vehicle(0.1, 1 - (60 - k) / 1e6) for k in range(40)] + [vehicle(1.0, 1 - k / 1e6) for k in range(20)])
    here = evaluator(test="CPFA", speed=30)
    whole = msgspec.structs.asdict(assess_preventability(here, np.concatenate([collisions, collisions])).shares)
    assert whole == {"competent_driver": pytest.approx(1 / 3), "full_braking": 0, "nobody": pytest.approx(2 / 3), "looked_at": 60,
                     "interval_competent_driver": [pytest.approx(1 / 3)] * 2}
    sample = msgspec.structs.asdict(assess_preventability(here, collisions, max_simulations=60).shares)
    assert sample["looked_at"] == 30
    assert sample == msgspec.structs.asdict(assess_preventability(here, collisions[::-1], max_simulations=60).shares)
    hits = round(sample["competent_driver"] * 30)
    expected = scipy.stats.beta.ppf(0.025, hits, 31 - hits), scipy.stats.beta.ppf(0.975, hits + 1, 30 - hits)
    assert sample["interval_competent_driver"] == pytest.approx(expected)
    assert expected[0] < 1 / 3 < expected[1]


@pytest.mark.slow
def test_reference_drivers_approach_as_the_driving_system_does() -> None:
    """A competent driver sees no danger before the time to collision is 2 s: until then both are at the same place."""
    rain = assemble(load_study("rain"))
    original = rain.characteristics.original[np.newaxis]
    driver = msgspec.convert(approach_parameters(rain), CompetentDriver)
    theirs, his = (simulate(one, original).trace for one in (rain, replace(rain, ads=driver)))
    danger = int(np.argmax(theirs.gap[:, 0] < 2 * theirs.speed[:, 0]))
    assert theirs.speed[danger, 0] > 4
    assert np.array_equal(theirs.position[:danger + 1], his.position[:danger + 1])
    assert approach_parameters(assemble(evaluator(test="CPFA", speed=30).study)) == {}


@pytest.mark.slow
def test_in_a_matrix_the_worst_point_counts() -> None:
    """The child that comes out late is hit at twice the speed: full braking avoids it, a competent driver does not."""
    speeds = {"CPFA": 20, "CPNCO": 40}
    tests = [msgspec.structs.replace(one, over={}, parameters={**one.parameters, "speed": speeds[one.name]}, weathers=[])
             for one in STUDY.matrix.tests if one.name in speeds]
    study = msgspec.structs.replace(STUDY, ads=BLIND, matrix=msgspec.structs.replace(STUDY.matrix, tests=tests))
    assert classify_collisions(Evaluator(study, InlinePool()), vehicle()[np.newaxis]) == [PreventableBy.FULL_BRAKING]


TESTS = [{"name": "CPLA", "model": "along", "over": {"speed": [20, 40]}, "weathers": ["clear", "night"]},
         {"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [30]}}]


@pytest.fixture(scope="module")
def system() -> System:
    return assemble(load_study("euro_ncap_pedestrian", matrix={"tests": TESTS}))


@pytest.fixture(scope="module")
def weak(system: System) -> np.ndarray:
    """Half the brakes."""
    setting = system.characteristics.original.copy()
    setting[system.characteristics.names.index("maxBrakeTorque")] /= 2
    return setting[np.newaxis]


@pytest.fixture(scope="module")
def failure(system: System, weak: np.ndarray) -> PointComparison:
    (one,), step = compare_at_points(system, system.characteristics.original[np.newaxis], weak, Unsafe())
    assert step == 0.05
    return one


@pytest.mark.slow
def test_it_fails_where_it_collides_when_simulated_there_alone(system: System, weak: np.ndarray, failure: PointComparison) -> None:
    alone = [point.name for point in system.points if evaluate(system.at(point), weak).collided[0]]
    assert list(failure.failing_points) == alone == ["CPLA, speed 40, clear", "CPLA, speed 40, night", "CPFA, speed 30, clear"]


def test_both_vehicles_are_compared_at_the_point_where_the_failure_is_worst(system: System, weak: np.ndarray,
                                                                            failure: PointComparison) -> None:
    assert failure.braking.changed.safety_degree == evaluate(system, weak).f_safe[0]
    at = next(point for point in system.points if point.name == failure.braking.point)
    original = evaluate(system.at(at), system.characteristics.original[np.newaxis])
    assert failure.braking.original.safety_degree == original.f_safe[0]
    assert sentence(failure.braking).startswith(f"At {at.name}: the original ")


def test_points_in_words() -> None:
    assert points_in_words(("A, 1", "B"), 9) == "Fails at 2 of 9 points: A, 1; B."
    assert points_in_words(("A", "B", "C"), 9, limit=1) == "Fails at 3 of 9 points: A and 2 more."
    assert points_in_words((), 9) == "Fails at 0 of 9 points."


@pytest.mark.slow
def test_the_summary_of_a_matrix_asks_why_at_the_worst_point_alone(system: System, weak: np.ndarray, failure: PointComparison) -> None:
    study = load_study("euro_ncap_pedestrian", matrix={"tests": TESTS})
    solutions = solutions_frame(system.characteristics.names, [(("nsga2", 0), evaluate(system, weak))])
    original = evaluate(system, system.characteristics.original[np.newaxis])
    more = summarise_failures(study, solutions, original, InlinePool(), "out")[-1]
    assert more.endswith(f": python -m safevar_sumo explain out --point '{failure.braking.point}'")
