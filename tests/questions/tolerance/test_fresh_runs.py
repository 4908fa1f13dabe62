"""Limits of vehicles whose runs differ: the worst vehicles of a search are simulated again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safevar_sumo.questions.cases import Counterexamples
from safevar_sumo.questions.drives import Drives, Judged, Scope
from safevar_sumo.questions.tolerance.search import _in_fresh_runs
from safevar_sumo.records import FloatArray
from tests.support.made_up_studies import drives_of, scope_of

pytestmark = pytest.mark.usefixtures("made_up_studies")

RUNS = 20


def task_of(robustness: FloatArray, *, has_repeats: bool = True) -> Any:
    """A task whose bench gives this robustness to drives that are simulated in fresh runs."""

    def drive(drives: Drives, *, anew: bool) -> Judged:
        assert anew
        return Judged.simulated(drives, robustness)

    evaluator = SimpleNamespace(
        has_repeats=has_repeats, number_of_fresh_runs=lambda settings: RUNS
    )
    own = SimpleNamespace(evaluator=evaluator)
    bench = SimpleNamespace(own=own, drive=drive)
    return SimpleNamespace(bench=bench)


def search(scope: Scope, start: Drives) -> Counterexamples:
    """A search that simulated nine drives, and found none of them unsafe."""
    judged = Judged.simulated(drives_of([0.9], [0.8]), np.array([0.2, 0.3]))
    return Counterexamples(judged, 9, 9)


@pytest.mark.parametrize("fresh", [-0.1, 0.1])
def test_a_box_fails_where_a_fresh_run_of_its_worst_vehicles_does(
    fresh: float,
) -> None:
    repeated = _in_fresh_runs(task_of(np.array([0.5, fresh])), search)
    scope = scope_of(1)
    results = repeated(scope, scope.nothing)
    unsafe = [[0.8]] if fresh < 0 else []
    assert results.unsafe.vehicle.tolist() == unsafe
    assert (results.simulated, results.counted) == (9, 9)
    assert results.repeated == 2 * RUNS


def test_without_repeats_a_search_stays_as_it_is() -> None:
    task = task_of(np.zeros(2), has_repeats=False)
    assert _in_fresh_runs(task, search) is search
