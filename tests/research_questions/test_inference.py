"""U test and effect size against closed forms, a count over all pairs, and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from safevar_sumo.analysis.research_questions.comparisons import ASYMPTOTIC, EXACT, Comparison, compare, magnitude
from safevar_sumo.errors import InputError

SAMPLES = st.lists(st.integers(-5, 5).map(float), min_size=1, max_size=20)


@given(x=SAMPLES, y=SAMPLES)
def test_effect_size_is_the_share_of_pairs_won_and_half_of_those_tied(x: list[float], y: list[float]) -> None:
    won = sum((a > b) + 0.5 * (a == b) for a in x for b in y)
    assert compare(x, y).effect_size == pytest.approx(won / (len(x) * len(y)))
    assert compare(y, x).effect_size == pytest.approx(1 - won / (len(x) * len(y)))
    assert compare(y, x).p_value == pytest.approx(compare(x, y).p_value)


@given(x=SAMPLES, y=SAMPLES)
def test_p_is_never_undefined(x: list[float], y: list[float]) -> None:
    p = compare(x, y).p_value
    assert p is not None
    assert 0 <= p <= 1


@pytest.mark.parametrize("size", [2, 3, 5, 8])
def test_exact_p_of_separated_samples_is_two_orders_of_all(size: int) -> None:
    told = compare(np.arange(size), 100 + np.arange(size))
    assert told.p_value == pytest.approx(2 / math.comb(2 * size, size))
    assert (told.effect_size, told.magnitude, told.method) == (0, "large", EXACT)


def test_p_with_ties_is_the_corrected_normal_approximation() -> None:
    x, y = np.repeat([1.0, 2, 3, 4], [9, 7, 5, 3]), np.repeat([2.0, 3, 4, 5], [4, 6, 8, 2])
    both, n1, n2 = np.concatenate([x, y]), len(x), len(y)
    u = sum((a > b) + 0.5 * (a == b) for a in x for b in y)
    ties = np.unique(both, return_counts=True)[1]
    n = n1 + n2
    sigma = math.sqrt(n1 * n2 / 12 * (n + 1 - np.sum(ties**3 - ties) / (n * (n - 1))))
    expected = math.erfc((abs(u - n1 * n2 / 2) - 0.5) / sigma / math.sqrt(2))
    assert compare(x, y).p_value == pytest.approx(expected)
    assert compare(x, y).method == ASYMPTOTIC


def test_thirty_against_thirty_is_scipys_own_choice() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=30), rng.normal(0.5, size=30)
    assert compare(x, y).p_value == pytest.approx(mannwhitneyu(x, y).pvalue)


def test_equal_samples_do_not_differ() -> None:
    for x, y in (([1.0] * 30, [1.0] * 30), ([2.0], [2.0]), ([1.0, 2, 3], [1.0, 2, 3])):
        assert compare(x, y)[:3] == (pytest.approx(1), 0.5, "negligible")


def test_one_value_against_one_says_nothing() -> None:
    assert compare([1.0], [2.0]) == Comparison(1.0, 0.0, "large", 1, 1, EXACT)


def test_an_empty_sample_is_undefined_not_zero() -> None:
    assert compare([], [1.0, 2]) == Comparison(None, None, None, 0, 2, None)
    assert compare([1.0], []) == Comparison(None, None, None, 1, 0, None)


def test_nan_is_refused() -> None:
    with pytest.raises(InputError, match="NaN"):
        compare([1.0, math.nan], [1.0])


@pytest.mark.parametrize(("effect", "name"), [
    (0.5, "negligible"), (0.444, "small"), (0.4441, "negligible"), (0.5559, "negligible"), (0.556, "small"), (0.6379, "small"),
    (0.638, "medium"), (0.7139, "medium"), (0.714, "large"), (1, "large"), (0.362, "medium"), (0.3621, "small"), (0.286, "large"),
    (0.2861, "medium"), (0, "large"), (1 - 0.714, "large"), (1 - 0.638, "medium"), (1 - 0.556, "small")])
def test_magnitudes_are_kitchenhams(effect: float, name: str) -> None:
    assert magnitude(effect) == name
