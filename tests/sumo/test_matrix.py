"""Settings in a matrix: the worst point counts, whatever the batch, the order of points and what else is in the matrix."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations
from safevar_sumo.study import MatrixTable, MatrixTest, Study, load_study
from safevar_sumo.sumo import matrix
from safevar_sumo.sumo.batch import score
from safevar_sumo.sumo.matrix import at_every_point, evaluate, named_point, simulate
from safevar_sumo.sumo.system import System, assemble

BASE = load_study("euro_ncap_pedestrian")
TESTS = [
    MatrixTest(name="CPNA", parameters={"test": "CPNA"}, over={"speed": [20, 50], "impact_location": [25, 75]},
               weathers=["clear", "carla_hard_rain"]),
    MatrixTest(name="CPNCO", parameters={"test": "CPNCO"}, over={"speed": [40]}),
    MatrixTest(name="CPLA", model="along", over={"speed": [30]}),
]


def study(tests: list[MatrixTest]) -> Study:
    return msgspec.structs.replace(BASE, matrix=MatrixTable(tests=tests))


SYSTEM = assemble(study(TESTS))


def drawn(system: System, n: int) -> np.ndarray:
    c = system.characteristics
    return c.filter(np.random.default_rng(3).uniform(c.lower, c.upper, (n, len(c))))


def same(one: Evaluations, other: Evaluations) -> bool:
    return bool((one.outcome == other.outcome).all()) and all(
        one.metrics[name].tobytes() == other.metrics[name].tobytes() for name in one.metrics)


def test_a_setting_is_worth_what_it_is_at_its_worst_point_and_each_point_is_as_if_alone() -> None:
    population = drawn(SYSTEM, 3)
    found = at_every_point(SYSTEM, population)
    assert [one.point.name for one in found][:3] == [
        "CPNA, speed 20, impact_location 25, clear", "CPNA, speed 20, impact_location 25, carla_hard_rain",
        "CPNA, speed 20, impact_location 75, clear"]
    assert len(found) == 10
    for one in found[::3]:
        alone = evaluate(SYSTEM.at(one.point), population)
        assert same(alone, one.evaluations), one.point.name
    whole = evaluate(SYSTEM, population)
    assert whole.f_safe.tolist() == np.min([one.evaluations.f_safe for one in found], axis=0).tolist()
    assert same(whole, score(SYSTEM, population, simulate(SYSTEM, population)))
    collided = [one.evaluations.collided for one in found]
    assert whole.collided.tolist() == np.any(collided, axis=0).tolist()


def test_neither_the_batch_nor_the_order_of_points_nor_how_many_share_a_simulation_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    population = drawn(SYSTEM, 3)
    whole = evaluate(SYSTEM, population)
    assert same(evaluate(SYSTEM, population[1:3]), whole.take([1, 2]))
    assert same(evaluate(assemble(study(TESTS[::-1])), population), whole)
    monkeypatch.setattr(matrix, "LARGEST_WORLD", 7)
    assert same(evaluate(SYSTEM, population), whole)


def test_a_mean_of_distances_and_speeds_is_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)wear.toml: matrix\.aggregate = 'mean'.*'worst'"):
        load_study("wear", matrix={"aggregate": "mean", "tests": [{"name": "CPNA", "parameters": {"test": "CPNA"}}]})


def test_a_point_is_named() -> None:
    assert named_point(SYSTEM, "CPLA, speed 30, clear", "--point").scenario.speed == 30  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="CPNCO, speed 40, clear"):
        named_point(SYSTEM, "CPNCO", "--point")


def test_who_names_no_point_is_told_the_nearest_ones_and_how_many_there_are() -> None:
    with pytest.raises(InputError) as told:
        named_point(assemble(load_study("euro_ncap_pedestrian")), "CPNA, speed 50", "--point")
    ahead, _, names = told.value.legal.partition(": ")
    assert ahead == "one of 72 points, the nearest of them"
    assert all(name.startswith("CPNA, speed 50, ") for name in names.split("; "))
    assert len(names.split("; ")) == matrix.NEAREST
    with pytest.raises(InputError, match="a study with a matrix"):
        named_point(assemble(load_study("sun")), "CPNA", "--point")


@pytest.mark.parametrize(("tests", "told"), [
    ([TESTS[2], TESTS[2]], "2 points are 'CPLA"),
    ([MatrixTest(name="x", over={"spede": [1]})], "spede"),
    ([MatrixTest(name="x", over={"speed": [-1]})], "speed"),
    ([MatrixTest(name="x", weathers=["sunny"])], "sunny"),
    ([MatrixTest(name="x", model="nothing")], "nothing"),
])
def test_what_is_wrong_in_a_matrix_is_told(tests: list[MatrixTest], told: str) -> None:
    with pytest.raises(InputError, match=told):
        assemble(study(tests))
