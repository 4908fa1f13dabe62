"""In which points of a matrix a failure fails, and how it differs there from the original at the same point."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.explain.braking_comparison import sentence
from safevar_sumo.analysis.explain.compute import Where, points_in_words, where
from safevar_sumo.analysis.explain.summary import lead
from safevar_sumo.analysis.words import command
from safevar_sumo.errors import InputError
from safevar_sumo.results import solutions_frame
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate, study_at
from safevar_sumo.sumo.system import System, assemble
from tests.in_process import Here

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
def told(system: System, weak: np.ndarray) -> Where:
    (one,), step = where(system, system.characteristics.original[np.newaxis], weak, Unsafe())
    assert step == 0.05
    return one


def test_it_fails_where_it_collides_when_simulated_there_alone(system: System, weak: np.ndarray, told: Where) -> None:
    alone = [point.name for point in system.points if evaluate(system.at(point), weak).collided[0]]
    assert list(told.points) == alone == ["CPLA, speed 40, clear", "CPLA, speed 40, night", "CPFA, speed 30, clear"]


def test_both_vehicles_are_compared_at_the_point_where_the_failure_is_worst(system: System, weak: np.ndarray, told: Where) -> None:
    assert told.because.changed.safety_degree == evaluate(system, weak).f_safe[0]
    at = next(point for point in system.points if point.name == told.because.place)
    original = evaluate(system.at(at), system.characteristics.original[np.newaxis])
    assert told.because.original.safety_degree == original.f_safe[0]
    assert sentence(told.because).startswith(f"At {at.name}: the original ")


def test_points_in_words() -> None:
    assert points_in_words(("A, 1", "B"), 9) == "Fails at 2 of 9 points: A, 1; B."
    assert points_in_words(("A", "B", "C"), 9, most=1) == "Fails at 3 of 9 points: A and 2 more."
    assert points_in_words((), 9) == "Fails at 0 of 9 points."


def test_what_was_asked_at_a_point_is_simulated_again_there() -> None:
    again = command("results/a b", {"mass": 2600.5}, "CPNA, speed 40")
    assert again == "python -m safevar_sumo simulate 'results/a b' --point 'CPNA, speed 40' --set mass=2600.5"
    assert command("rain", {}) == "python -m safevar_sumo simulate rain"


def test_the_summary_of_a_matrix_asks_why_at_the_worst_point_alone(system: System, weak: np.ndarray, told: Where) -> None:
    study = load_study("euro_ncap_pedestrian", matrix={"tests": TESTS})
    solutions = solutions_frame(system.characteristics.names, [(("nsga2", 0), evaluate(system, weak))])
    original = evaluate(system, system.characteristics.original[np.newaxis])
    more = lead(study, solutions, original, Here(), "out")[-1]
    assert more.endswith(f": python -m safevar_sumo explain out --point '{told.because.place}'")


def test_a_question_may_be_about_one_point_alone(system: System, weak: np.ndarray) -> None:
    study = load_study("euro_ncap_pedestrian", matrix={"tests": TESTS})
    for point in system.points:
        alone = assemble(study_at(study, point.name, "--point"))
        assert [one.name for one in alone.points] == [point.name]
        assert evaluate(alone, weak).f_safe[0] == evaluate(system.at(point), weak).f_safe[0]
    with pytest.raises(InputError, match=r"--point: 'CPLA'"):
        study_at(study, "CPLA", "--point")
