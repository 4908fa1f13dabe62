"""Whether a failure is robust: shares of unsafe neighbours, and the search for the robust failure with the fewest
changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain.robustness import (
    STEP_FACTORS,
    Robustness,
    estimate_robustness,
    find_smallest_robust_failure,
)
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray
from tests.analysis.known_regions import box, made_up_evaluator

COLLISION = Unsafe()


def test_robust_is_what_its_neighbours_are_too() -> None:
    evaluator = made_up_evaluator(2, box)
    threshold = evaluator.characteristics.threshold[0]
    deep, edge = estimate_robustness(evaluator, np.array([[9.0, 1.0], [7.0, 1.0]]), 0.1, COLLISION)
    assert deep.shares_by_step == {0.1: 1.0, 0.05: 1.0, 0.2: 1.0}
    assert edge.share == pytest.approx(0.5, abs=0.2)
    assert (deep.borderline, edge.borderline) == (False, True)
    (beyond,) = estimate_robustness(evaluator, np.array([[7.0 + 1.01 * threshold, 1.0]]), 0.1, COLLISION)
    assert beyond.share == 1.0


def test_the_smallest_robust_failure_is_the_first_whose_neighbours_are_unsafe_too() -> None:
    """Largest changes of 40, 70 and 80 %; the first lies at the edge of the box."""
    evaluator = made_up_evaluator(2, box)
    failures = evaluator.evaluate(np.array([[9.0, 1.0], [7.01, 2.99], [8.5, 2.0]]), "failures")
    assert find_smallest_robust_failure(evaluator, failures, 0.1, COLLISION, max_evaluations=1) == 2
    assert find_smallest_robust_failure(evaluator, failures.take([1]), 0.1, COLLISION, max_evaluations=1) is None


@pytest.mark.parametrize(
    ("shares", "row"),
    [
        ([(0.5, 1.0, 1.0), (0.9, 0.9, 0.9)], 0),
        ([(0.39, 1.0, 1.0), (0.9, 0.9, 0.9)], 1),
        ([(0.9, 0.6, 0.8), (0.41, 1.0, 1.0)], 1),
        ([(0.79, 0.79, 0.79), (1.0, 1.0, 0.3)], None),
    ],
)
def test_a_failure_is_robust_by_the_mean_of_all_time_steps(
    shares: list[tuple[float, ...]], row: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the study's own time step says, if the other steps can make up for it."""
    evaluator, factors_of_calls = made_up_evaluator(2, box), []

    def estimates(
        _: Evaluator, settings: FloatArray, step: float, unsafe: Unsafe, factors: Sequence[float]
    ) -> list[Robustness]:
        factors_of_calls.append((len(settings), tuple(factors)))
        return [
            Robustness({step * factor: shares[int(setting[0]) - 8][STEP_FACTORS.index(factor)] for factor in factors})
            for setting in settings
        ]

    monkeypatch.setattr("safevar_sumo.analysis.explain.robustness.estimate_robustness", estimates)
    failures = evaluator.evaluate(np.array([[8.0, 1.0], [9.0, 1.0]]), "failures")
    assert find_smallest_robust_failure(evaluator, failures, 0.1, COLLISION, max_evaluations=1) == row
    candidates = sum(first > 0.39 for first, *_ in shares)
    assert factors_of_calls == [(2, STEP_FACTORS[:1]), (candidates, STEP_FACTORS[1:])]
