"""Minimal causes and their boundaries against brute force and known regions."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from safevar_sumo.analysis.criterion import Unsafe
from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.analysis.explain.causes import RESOLUTION, End, affordable, boundaries, involved, minimal_causes, necessary
from safevar_sumo.analysis.explain.necessity import distinct_causes, necessity, robustness, smallest_robust
from safevar_sumo.records import BoolArray, FloatArray
from tests.analysis.known_regions import ORIGINAL, Plant, box, everywhere, made_up_bench, made_up_study, two_islands

COLLISION = Unsafe()


@given(table=st.lists(st.booleans(), min_size=32, max_size=32), full=st.integers(0, 31))
def test_all_smallest_unsafe_subsets_and_no_other_whatever_the_outcomes(table: list[bool], full: int) -> None:
    def outcome(settings: FloatArray) -> BoolArray:
        """Any function of which characteristics are changed, monotone or not."""
        return np.array(table)[(settings != ORIGINAL) @ (1 << np.arange(5))]

    setting = np.where(full >> np.arange(5) & 1, 9.0, ORIGINAL)
    columns = np.flatnonzero(setting != ORIGINAL).tolist()
    unsafe = [set(subset) for size in range(len(columns) + 1) for subset in combinations(columns, size)
              if table[sum(1 << column for column in subset)]]
    smallest = [subset for subset in unsafe if len(subset) == min(map(len, unsafe))]
    (found,) = minimal_causes(made_up_bench(5, outcome), setting[np.newaxis], COLLISION)
    assert [set(cause.columns) for cause in found] == smallest
    for cause in found:
        assert not any(set(subset) < set(cause.columns) for subset in unsafe)
    assert necessary(found) == (set.intersection(*smallest) if smallest else set())
    assert involved(found) == set().union(*smallest)


def test_a_boundary_is_the_first_unsafe_place_and_no_island_is_skipped() -> None:
    bench = made_up_bench(3, two_islands)
    (causes,) = minimal_causes(bench, np.array([[9.5, 1.0, 8.0]]), COLLISION)
    (found,) = boundaries(bench, causes, COLLISION)
    assert found.fraction == pytest.approx(1.5 / 4.5, abs=2 * RESOLUTION)
    assert found.setting[0] > 6.5 >= found.setting[0] - 2 * RESOLUTION * 4.5
    assert found.alone == {0: found.setting[0]}
    assert (found.end, found.at_threshold) == (End.SAFE, None)


def test_each_value_of_a_cause_alone_goes_back_farther_than_all_together() -> None:
    bench = made_up_bench(2, lambda settings: settings[:, 0] - settings[:, 1] >= 6)
    (causes,) = minimal_causes(bench, np.array([[9.0, 1.0]]), COLLISION)
    (found,) = boundaries(bench, causes, COLLISION)
    assert found.fraction == pytest.approx(6 / 8, abs=2 * RESOLUTION)
    assert found.setting == pytest.approx([8, 2], abs=1e-3)
    assert found.alone == {0: pytest.approx(7, abs=1e-3), 1: pytest.approx(3, abs=1e-3)}


def test_nothing_is_shrunk_into_what_the_filter_takes_for_no_change() -> None:
    bench = made_up_bench(1, lambda settings: settings[:, 0] > ORIGINAL)
    (causes,) = minimal_causes(bench, np.array([[9.0]]), COLLISION)
    (found,) = boundaries(bench, causes, COLLISION)
    threshold = bench.characteristics.threshold[0]
    assert found.setting[0] == pytest.approx(ORIGINAL + threshold, rel=1e-3)
    assert bench.characteristics.filter(found.setting)[0] == found.setting[0]
    assert (found.end, found.at_threshold) == (End.FILTER, 0)


def test_a_boundary_that_ends_where_nothing_can_be_simulated_says_so() -> None:
    study = made_up_study(1)
    bench = Bench(study, Plant(study, lambda rows: rows[:, 0] > 7, failing=lambda rows: (rows[:, 0] > 6) & (rows[:, 0] <= 7)))
    (causes,) = minimal_causes(bench, np.array([[9.0]]), COLLISION)
    (found,) = boundaries(bench, causes, COLLISION)
    assert (found.setting[0], found.end) == (pytest.approx(7, abs=1e-3), End.NOT_SIMULATED)


def test_an_original_that_is_unsafe_itself_needs_no_change() -> None:
    bench = made_up_bench(2, everywhere)
    (causes,) = minimal_causes(bench, np.array([[9.0, 1.0]]), COLLISION)
    (found,) = boundaries(bench, causes, COLLISION)
    assert (found.fraction, found.alone) == (0.0, {})


def test_robust_is_what_its_neighbours_are_too() -> None:
    bench = made_up_bench(2, box)
    threshold = bench.characteristics.threshold[0]
    deep, edge = robustness(bench, np.array([[9.0, 1.0], [7.0, 1.0]]), 0.1, COLLISION)
    assert deep.by_step == {0.1: 1.0, 0.05: 1.0, 0.2: 1.0}
    assert edge.share == pytest.approx(0.5, abs=0.2)
    assert (deep.borderline, edge.borderline) == (False, True)
    (beyond,) = robustness(bench, np.array([[7.0 + 1.01 * threshold, 1.0]]), 0.1, COLLISION)
    assert beyond.share == 1.0


def test_the_smallest_robust_failure_is_the_first_whose_neighbours_are_unsafe_too() -> None:
    """Largest changes of 40, 70 and 80 %; the first lies at the edge of the box."""
    bench = made_up_bench(2, box)
    failures = bench.evaluate(np.array([[9.0, 1.0], [7.01, 2.99], [8.5, 2.0]]), "failures")
    assert smallest_robust(bench, failures, 0.1, COLLISION, limit=1) == 2
    assert smallest_robust(bench, failures.take([1]), 0.1, COLLISION, limit=1) is None


def test_necessary_and_changed_over_failures() -> None:
    bench = made_up_bench(3, lambda settings: box(settings) | (settings[:, 2] > 9))
    settings = np.array([[9.0, 1.0, 5.0], [9.0, 1.0, 8.0], [9.0, 1.0, 9.5]])
    causes = minimal_causes(bench, settings, COLLISION)
    frame = necessity(bench.characteristics, bench.characteristics.changed(settings), causes, 3).set_index("characteristic")
    assert frame["changed"].to_dict() == pytest.approx({"a": 1, "b": 1, "c": 2 / 3})
    assert frame["necessary"].to_dict() == pytest.approx({"a": 2 / 3, "b": 2 / 3, "c": 1 / 3})
    assert frame["necessary_lower"].equals(frame["necessary"]), "of all failures the shares are exact"
    sampled = necessity(bench.characteristics, bench.characteristics.changed(settings), causes, 4).set_index("characteristic").loc["c"]
    ends = [scipy.stats.beta.ppf(q, *shape) for q, shape in ((0.025, (1, 3)), (0.975, (2, 2)))]
    assert sampled[["necessary_lower", "necessary_upper"]].tolist() == pytest.approx(ends), "1 of a sample of 3"
    distinct = distinct_causes(bench.characteristics, causes)
    assert list(zip(distinct["cause"], distinct["failures"], strict=True)) == [(("a up", "b down"), 2), (("c up",), 1)]


def test_more_failures_than_can_be_afforded_are_sampled_and_always_the_same() -> None:
    bench = made_up_bench(8, everywhere)
    settings = np.random.default_rng(1).uniform(6, 9, (50, 8))
    few = affordable(settings, bench, 2000)
    assert few == affordable(settings, bench, 2000)
    assert 0 < len(few) < 50
    assert affordable(settings, bench, 10**6) == list(range(50))
