"""IGD, IGD+ and hypervolume against closed forms and their definitions; what has no value is refused."""

from __future__ import annotations

import math
from typing import Any

import moocore
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safevar_sumo.analysis.research_questions.comparisons import ASYMPTOTIC_TEST, EXACT_TEST, TwoSampleTest, compare_samples, magnitude_of
from safevar_sumo.analysis.research_questions.indicators import (
    Scale,
    compute_convergence,
    compute_indicators,
    defined_minimised_values,
    hypervolume,
    igd,
    igd_plus,
    nondominated_points,
    reference_front,
)
from safevar_sumo.errors import InputError
from tests.research_questions.made_up import made_up, row

FRONT = np.array([[0.0, 1, 2], [1, 0, 1], [2, 2, 0]])


def test_igd_is_the_mean_distance_to_the_nearest_point() -> None:
    rng = np.random.default_rng(5)
    front, reference = rng.normal(size=(7, 3)), rng.normal(size=(11, 3))
    between = np.linalg.norm(reference[:, None] - front[None], axis=2)
    assert igd(front, reference) == pytest.approx(between.min(axis=1).mean())
    worse = np.linalg.norm(np.maximum(front[None] - reference[:, None], 0), axis=2)
    assert igd_plus(front, reference) == pytest.approx(worse.min(axis=1).mean())


def test_igd_plus_does_not_count_what_is_better() -> None:
    assert igd(FRONT - 1, FRONT) > 0
    assert igd_plus(FRONT - 1, FRONT) == 0
    assert igd_plus(FRONT + np.array([0, 0.25, 0]), FRONT) == pytest.approx(0.25)


def test_hypervolume_of_boxes() -> None:
    assert hypervolume(np.zeros((1, 3))) == pytest.approx(1.1**3)
    assert hypervolume(np.array([[0.0, 1], [1, 0]])) == pytest.approx(2 * 1.1 * 0.1 - 0.1**2)
    assert hypervolume(np.full((1, 3), 1.2)) == 0


@pytest.mark.parametrize("indicator", [lambda front: igd(front, FRONT), lambda front: igd_plus(front, FRONT), hypervolume,
                                       nondominated_points, lambda front: igd(FRONT, front)])
@pytest.mark.parametrize("front", [np.zeros((0, 3)), np.array([[math.nan, 0, 0]]), np.array([[math.inf, 0, 0]])])
def test_no_indicator_of_an_empty_or_undefined_front(indicator: Any, front: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"empty|undefined"):
        indicator(front)


def test_nondominated_points_are_those_that_none_dominates() -> None:
    points = np.random.default_rng(7).integers(0, 5, size=(60, 3)).astype(float)
    kept = {tuple(one) for one in points if not any((other <= one).all() and (other < one).any() for other in points)}
    result = nondominated_points(points)
    assert {tuple(one) for one in result} == kept
    assert len(result) == len(kept)


def test_scale_maps_ideal_to_0_and_nadir_to_1() -> None:
    scale = Scale.of(FRONT)
    assert scale.normalised(FRONT).min() == 0
    assert scale.normalised(FRONT).max() == 1
    flat = Scale.of(np.array([[1.0, 5, 3], [2, 4, 3]]))
    assert np.isfinite(flat.normalised(np.array([[1.0, 5, 7]]))).all()


def test_the_reference_front_is_of_all_runs_of_all_algorithms() -> None:
    case = made_up(row(sd=1, f_diff=0.5), row("rs", sd=0.5, f_diff=0.7), row("rs", run=1, sd=1, f_diff=0.6))
    assert sorted(reference_front(case).tolist()) == [[0.5, 0.7, 0], [1, 0.5, 0]]


def test_indicators_are_those_of_each_runs_own_front() -> None:
    case = made_up(row(sd=1, f_diff=0.5), row("rs", sd=0.5, f_diff=0.7), row("rs", run=1, sd=1, f_diff=0.6))
    result = compute_indicators(case).set_index(["algorithm", "run"])
    apart = math.hypot(0.5, 0.2)
    assert result.loc[("nsga2", 0), "igd"] == pytest.approx(apart / 2)
    assert result.loc[("rs", 1), "igd"] == pytest.approx((0.1 + math.hypot(0.5, 0.1)) / 2)
    assert result.loc[("nsga2", 0), "igd_plus"] == pytest.approx(0.5), "normalised: a whole width of f_safe away from one of two"
    assert result.loc[("rs", 0), "hypervolume"] == pytest.approx(1.1 * 0.1 * 1.1)


def test_convergence_grows_to_the_hypervolume_of_all() -> None:
    rng = np.random.default_rng(1)
    evaluations = [{**row("nsga2", run, sd=sd, f_diff=diff), "evaluation": i}
                   for run in (0, 1) for i, (sd, diff) in enumerate(rng.uniform(0.1, 1, size=(100 if run else 40, 2)))]
    case = made_up(row(sd=0.1, f_diff=1), row(run=1, sd=1, f_diff=0.1), evaluations=evaluations)
    grown = compute_convergence(case)
    assert set(grown["evaluations"]) >= {10, 100}
    for run, group in grown.groupby("run"):
        assert (np.diff(group["hypervolume"]) >= 0).all()
        seen = case.evaluations[case.evaluations["run"] == run]
        normal = Scale.of(reference_front(case)).normalised(defined_minimised_values(case, seen))
        assert group["hypervolume"].iloc[-1] == pytest.approx(moocore.hypervolume(normal, ref=[1.1] * 3))
    early = grown[grown["run"] == 0]
    assert early.loc[early["evaluations"] >= 40, "hypervolume"].nunique() == 1, "a run that ended early keeps what it had"


SAMPLES = st.lists(st.integers(-5, 5).map(float), min_size=1, max_size=20)


@pytest.mark.slow
@given(x=SAMPLES, y=SAMPLES)
def test_effect_size_is_the_share_of_pairs_won_and_half_of_those_tied(x: list[float], y: list[float]) -> None:
    won = sum((a > b) + 0.5 * (a == b) for a in x for b in y)
    assert compare_samples(x, y).effect_size == pytest.approx(won / (len(x) * len(y)))
    assert compare_samples(y, x).effect_size == pytest.approx(1 - won / (len(x) * len(y)))
    assert compare_samples(y, x).p_value == pytest.approx(compare_samples(x, y).p_value)


@given(x=SAMPLES, y=SAMPLES)
def test_p_is_never_undefined(x: list[float], y: list[float]) -> None:
    p = compare_samples(x, y).p_value
    assert p is not None
    assert 0 <= p <= 1


@pytest.mark.parametrize("size", [2, 3, 5, 8])
def test_exact_p_of_separated_samples_is_two_orders_of_all(size: int) -> None:
    result = compare_samples(np.arange(size), 100 + np.arange(size))
    assert result.p_value == pytest.approx(2 / math.comb(2 * size, size))
    assert (result.effect_size, result.magnitude, result.method) == (0, "large", EXACT_TEST)


def test_p_with_ties_is_the_corrected_normal_approximation() -> None:
    x, y = np.repeat([1.0, 2, 3, 4], [9, 7, 5, 3]), np.repeat([2.0, 3, 4, 5], [4, 6, 8, 2])
    both, n1, n2 = np.concatenate([x, y]), len(x), len(y)
    u = sum((a > b) + 0.5 * (a == b) for a in x for b in y)
    ties = np.unique(both, return_counts=True)[1]
    n = n1 + n2
    sigma = math.sqrt(n1 * n2 / 12 * (n + 1 - np.sum(ties**3 - ties) / (n * (n - 1))))
    expected = math.erfc((abs(u - n1 * n2 / 2) - 0.5) / sigma / math.sqrt(2))
    assert compare_samples(x, y).p_value == pytest.approx(expected)
    assert compare_samples(x, y).method == ASYMPTOTIC_TEST


def test_an_empty_sample_is_undefined_not_zero() -> None:
    assert compare_samples([], [1.0, 2]) == TwoSampleTest(None, None, None, 0, 2, None)
    assert compare_samples([1.0], []) == TwoSampleTest(None, None, None, 1, 0, None)


def test_nan_is_refused() -> None:
    with pytest.raises(InputError, match="NaN"):
        compare_samples([1.0, math.nan], [1.0])


@pytest.mark.parametrize(("effect", "name"), [
    (0.5, "negligible"), (0.444, "small"), (0.4441, "negligible"), (0.5559, "negligible"), (0.556, "small"), (0.6379, "small"),
    (0.638, "medium"), (0.7139, "medium"), (0.714, "large"), (1, "large"), (0.362, "medium"), (0.3621, "small"), (0.286, "large"),
    (0.2861, "medium"), (0, "large"), (1 - 0.714, "large"), (1 - 0.638, "medium"), (1 - 0.556, "small")])
def test_magnitudes_are_kitchenhams(effect: float, name: str) -> None:
    assert magnitude_of(effect) == name
