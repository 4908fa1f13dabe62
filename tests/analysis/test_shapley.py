"""Shapley effects against closed forms: linear functions of correlated normal values, and a simplex."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest

from safevar_sumo import risk
from safevar_sumo.analysis.risk.answer import Risk
from safevar_sumo.records import FloatArray
from safevar_sumo.study import load_study
from tests.analysis.known_regions import Plant, made_up_study, nowhere

NAMES = "abcdefghijkl"
SLOW = pytest.mark.slow


def closed_form(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """The mean, over all orders, of the growth of Var(Y | the others), which is a constant for a linear function."""
    d = len(slopes)

    def conditional(joined: tuple[int, ...]) -> float:
        others = np.setdiff1d(np.arange(d), joined)
        mixed = covariance[np.ix_(joined, others)]
        rest = covariance[np.ix_(joined, joined)] - mixed @ np.linalg.inv(covariance[np.ix_(others, others)]) @ mixed.T
        return float(slopes[list(joined)] @ rest @ slopes[list(joined)]) if joined else 0.0

    variances = {joined: conditional(joined) for size in range(d + 1) for joined in combinations(range(d), size)}
    effects = np.zeros(d)
    for joined, variance in variances.items():
        for one in joined:
            growth = variance - variances[tuple(other for other in joined if other != one)]
            effects[one] += growth / (d * math.comb(d - 1, len(joined) - 1))
    return effects


def linear(slopes: list[float], deviations: list[float], correlations: dict[tuple[int, int], float]) -> Risk:
    names = NAMES[: len(slopes)]
    study = load_study(
        made_up_study(len(slopes)),
        variation={
            name: {"distribution": "normal", "deviation": deviation}
            for name, deviation in zip(names, deviations, strict=True)
        },
        correlations=[{"between": [names[i], names[j]], "value": value} for (i, j), value in correlations.items()],
    )
    plant = Plant(study, nowhere, lambda settings: (settings - 5) @ np.array(slopes) + 10)
    return risk(study, unsafe="below=10", samples=200, pool=plant)


@pytest.mark.parametrize(
    ("slopes", "deviations", "correlations"),
    [
        ([1.0, 1.0], [0.5, 1.0], {(0, 1): -0.7}),
        ([1.0, 1.0, 1.0], [0.5, 0.5, 1.0], {(1, 2): 0.9}),
        *(
            pytest.param(
                [1.0, -1.0, 2.0, 1.5] * (d // 4), [0.5] * d, {(0, 1): 0.5, (2, 3): -0.6, (4, 7): 0.8}, marks=SLOW
            )
            for d in (8, 12)
        ),
    ],
)
def test_effects_of_correlated_normal_values_are_those_of_the_closed_form(
    slopes: list[float], deviations: list[float], correlations: dict[tuple[int, int], float]
) -> None:
    matrix = np.eye(len(slopes))
    for (i, j), value in correlations.items():
        matrix[i, j] = matrix[j, i] = value
    expected = closed_form(np.array(slopes), np.outer(deviations, deviations) * matrix)
    result = linear(slopes, deviations, correlations)
    frame = result.to_frame().set_index(["output", "characteristic"])
    effects = frame.loc["safety_degree", "effect"]
    np.testing.assert_allclose(effects, expected, rtol=0.02)
    assert effects.sum() == pytest.approx(expected.sum(), rel=0.02)
    assert frame["share"].groupby("output").sum().to_list() == [pytest.approx(1, abs=1e-12)] * 2
    assert result.to_dict()["sensitivity"] == []
    assert [row["effect"] for row in result.to_dict()["shapley"]] == effects.to_list()
    assert result.figure().axes


def test_a_constraint_a_characteristic_that_does_not_vary_and_an_output_that_does_not() -> None:
    """On the triangle a + b <= 10 of a square the conditional variance of a given b is (10 - b)^2 / 12."""
    study = load_study(
        made_up_study(3),
        variation={"c": {"distribution": "fixed"}},
        constraints=[{"sum": {"a": 1.0, "b": 1.0}, "at_most": 10.0}],
    )
    result = risk(study, samples=200, unsafe="below=-5", pool=Plant(study, nowhere, lambda settings: settings[:, 0]))
    frame = result.to_frame().set_index(["output", "characteristic"])
    variance, alone = 100 / 18, 50 / 12  # E[(10 - b)^2] / 12 with the density (10 - b) / 50
    expected = {"a": (alone + variance) / 2, "b": (variance - alone) / 2, "c": 0.0}
    assert frame.loc["safety_degree", "effect"].to_dict() == pytest.approx(expected, abs=0.02 * variance)
    assert frame.loc["unsafe", "share"].isna().all()
    words = "\n".join(part for part in result.sentences() if isinstance(part, str))
    assert "Shapley effects, which sum to 1" in words
    assert "There are no indices of the unsafe outcome" in words


@pytest.mark.parametrize("varying", [0, 1])
def test_one_characteristic_or_none_that_varies(varying: int) -> None:
    study = load_study(
        made_up_study(2),
        variation={name: {"distribution": "fixed"} for name in "ab"[varying:]},
        correlations=[{"between": ["a", "b"], "value": 0.5}],
    )
    result = risk(study, samples=50, unsafe="below=5", pool=Plant(study, nowhere, lambda settings: settings[:, 0]))
    shares = result.to_frame()["share"][:2]
    assert shares.to_list() == pytest.approx([1.0, 0.0]) if varying else shares.isna().all()
