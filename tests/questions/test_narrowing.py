"""The judge that spares points of a matrix at which no vehicle was worst."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from safevar_sumo.questions.models import Model
from safevar_sumo.questions.narrowing import LEAST_SHARE, NarrowedJudge
from safevar_sumo.records import FloatArray

POINTS = 12


class Matrix:
    """A model in which a setting leaves something else at each of twelve points, shape (M, 12), by
    which it was asked.
    """

    def __init__(self, left: FloatArray, points: tuple[int, ...] = (), scenario: Any = ()) -> None:
        self.left = left
        self.points = points
        self.asked = list[tuple[tuple[int, ...], int]]()
        self.evaluator = SimpleNamespace(
            characteristics=SimpleNamespace(scenario=scenario),
            system=SimpleNamespace(points=range(POINTS)),
            region=SimpleNamespace(feasible=lambda rows: np.ones(len(rows), dtype=bool)),
        )

    def _replace(self, points: tuple[int, ...]) -> Matrix:
        narrowed = Matrix(self.left, points)
        narrowed.asked = self.asked
        return narrowed

    def evaluate(self, settings: FloatArray, stage: str) -> Any:
        self.asked.append((self.points, len(settings)))
        columns = [*(self.points or range(POINTS))]
        left = self.left[settings[:, 0].astype(int)][:, columns]
        return SimpleNamespace(
            valid=np.ones(len(left), dtype=bool),
            worst_points=np.argmin(left, axis=1),
            left=left.min(axis=1),
        )

    def robustness_by(self, evaluations: Any) -> FloatArray:
        return evaluations.left

    def robustness(self, settings: FloatArray, stage: str) -> FloatArray:
        return self.robustness_by(self.evaluate(settings, stage))


def judge_of(matrix: Matrix) -> NarrowedJudge:
    return NarrowedJudge(cast(Model, matrix), "test")


def rows(first: int, last: int) -> FloatArray:
    return np.arange(first, last, dtype=float)[:, np.newaxis]


@pytest.mark.parametrize("seed", range(5))
def test_the_least_are_known_at_all_points(seed: int) -> None:
    """What is printed as the least of a search is what a vehicle leaves at its worst point."""
    left = np.random.default_rng(seed).uniform(1, 2, (400, POINTS))
    left[:, [3, 7]] -= 1
    matrix = Matrix(left)
    judge = judge_of(matrix)
    true = left.min(axis=1)
    assert (judge(rows(0, 80)) == true[:80]).all(), "the first ones meet all points"
    later = judge(rows(80, 400))
    assert (later >= true[80:]).all(), "nobody leaves more than he is said to leave"
    number = int(320 * LEAST_SHARE)
    assert (later == true[80:])[np.argsort(later, kind="stable")[:number]].all()
    asked_later = matrix.asked[1:]
    assert asked_later[0] == ((3, 7), 320), "only at points that were worst"
    assert judge.at_all_points == 80 + asked_later[1][1] < 200


def test_a_worst_point_that_appears_later_is_met_from_then_on() -> None:
    """A failure at a point that was never the worst is found beside a vehicle that leaves least."""
    left = np.full((300, POINTS), 2.0)
    left[:, 3] = 1.0
    left[100, 3] = 0.5  # leaves least at the known point, and fails at another one
    left[100, 9] = -1.0
    left[250, 9] = -0.2  # leaves as much as the others at the known point
    matrix = Matrix(left)
    judge = judge_of(matrix)
    judge(rows(0, 50))
    assert judge(rows(50, 150)).min() == -1
    assert judge(rows(240, 300))[10] == -0.2
    assert matrix.asked[-2][0] == (3, 9)


def test_in_a_searched_scenario_all_meet_everything() -> None:
    matrix = Matrix(np.ones((60, POINTS)), scenario=("speed",))
    judge = judge_of(matrix)
    judge(rows(0, 30))
    judge(rows(30, 60))
    assert judge.at_all_points == 60
    assert {points for points, _ in matrix.asked} == {()}
