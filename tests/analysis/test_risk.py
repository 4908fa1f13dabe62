"""Shares and probabilities: against analytic volumes, moments, Ishigami's function and analytic limit states."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy

from safevar_sumo import risk
from safevar_sumo.analysis.risk import compute, rare as rare_failures
from safevar_sumo.analysis.risk.answer import Risk
from safevar_sumo.analysis.risk.variation import VariationModel
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import load_study
from tests.analysis.known_regions import (
    Plant,
    Region,
    box,
    diagonal_band,
    everywhere,
    made_up_study,
    nowhere,
    two_islands,
)


def of(region: Region, **options: Any) -> Risk:
    study = made_up_study(2)
    return risk(study, unsafe="collision", pool=Plant(study, region), **options)


@pytest.mark.parametrize(
    ("region", "volume"), [(box, 0.09), (two_islands, 0.15), (diagonal_band, 0.06), (nowhere, 0.0), (everywhere, 1.0)]
)
def test_the_interval_holds_the_analytic_volume(region: Region, volume: float) -> None:
    result = of(region, samples=8000, confidence=0.999)
    low, high = result.interval
    assert low <= volume <= high
    assert high - low < 0.03
    assert result.probability == result.failures / 8000
    if volume:
        assert result.coefficient_of_variation == pytest.approx(math.sqrt((1 - volume) / (8000 * volume)), rel=0.15)


def test_it_stops_as_soon_as_it_is_sure_enough() -> None:
    result = of(box, samples=50_000, width=0.02)
    assert 1000 < result.samples < 10_000
    assert result.interval[1] - result.interval[0] <= 0.02


def ishigami(settings: FloatArray) -> FloatArray:
    x = (settings - 5) / 5 * math.pi
    return np.asarray(np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0]))


def test_sobol_indices_of_ishigamis_function() -> None:
    """Analytic values of Saltelli et al., Global Sensitivity Analysis (2008), for a = 7, b = 0.1."""
    study = made_up_study(3)
    result = risk(study, unsafe="collision", samples=100, pool=Plant(study, nowhere, ishigami))
    by_output = result.to_frame().set_index(["output", "characteristic"])
    frame = by_output.loc["safety_degree"]
    assert frame["first_order"].to_dict() == pytest.approx({"a": 0.3139, "b": 0.4424, "c": 0.0}, abs=0.05)
    assert frame["total"].to_dict() == pytest.approx({"a": 0.5576, "b": 0.4424, "c": 0.2437}, abs=0.05)
    assert (frame["first_order_lower"] < frame["first_order"]).all()
    assert by_output.loc["unsafe", "total"].isna().all()


def test_words_of_a_risk_claim_nothing_that_is_not_there() -> None:
    """Everything varies as specified, so there are no others; no fleet is certain to fail; 99.9 % is not 100 %."""
    normal = {"distribution": "normal", "deviation": 1.0}
    study = load_study(made_up_study(2), variation={"a": normal, "b": normal})
    result = risk(study, unsafe="collision", samples=200, confidence=0.999, pool=Plant(study, box))
    printed = " ".join(map(str, replace(result, probability=0.009).sentences()))
    assert "They vary as the study specifies: a normal; b normal." in printed
    assert "at least one is unsafe with probability above 0.99." in printed
    assert "with 99.9 % confidence" in printed


def test_the_promised_record_and_the_same_again() -> None:
    first, again = (json.dumps(of(box, samples=500).to_dict(), allow_nan=False) for _ in range(2))
    assert first == again
    record = json.loads(first)
    assert list(record) == [
        "study",
        "unsafe",
        "samples",
        "failures",
        "probability",
        "interval",
        "confidence",
        "sensitivity",
        "method",
        "simulations",
        "coefficient_of_variation",
        "design_point",
        "remark",
    ]
    assert list(record["sensitivity"][0]) == [
        "characteristic",
        "first_order",
        "total",
        "first_order_interval",
        "total_interval",
    ]
    infinite_intervals = of(box, samples=500, confidence=1 - 2**-53).to_dict()
    assert json.dumps(infinite_intervals, allow_nan=False)


def drawn(**variation: dict[str, Any]) -> FloatArray:
    correlations = variation.pop("correlations", [])
    study = load_study(made_up_study(2), variation=variation, correlations=correlations)
    return VariationModel(study).settings(np.random.default_rng(1).random((20_000, 2)))


def test_every_distribution_has_its_moments() -> None:
    normal, triangular = drawn(
        a={"distribution": "normal", "deviation": 0.5, "mean": 6.0}, b={"distribution": "triangular", "upper": 8.0}
    ).T
    assert (normal.mean(), normal.std()) == pytest.approx((6.0, 0.5), abs=0.02)
    assert (triangular.mean(), triangular.max()) == pytest.approx((13 / 3, 8.0), abs=0.1)
    fixed, uniform = drawn(a={"distribution": "fixed", "value": 7.0}, b={"distribution": "uniform", "lower": 2.0}).T
    assert set(fixed) == {7.0}
    assert (uniform.min(), uniform.mean()) == pytest.approx((2.0, 6.0), abs=0.05)
    tight = drawn(a={"distribution": "normal", "deviation": 50.0})[:, 0]
    assert tight.min() >= 0
    assert tight.max() <= 10


def test_correlations_are_those_of_the_copula() -> None:
    normal = {"distribution": "normal", "deviation": 0.5}
    settings = drawn(a=normal, b=normal, correlations=[{"between": ["a", "b"], "value": 0.8}])
    assert np.corrcoef(settings.T)[0, 1] == pytest.approx(0.8, abs=0.02)


Limit = Callable[[FloatArray], FloatArray]


def of_normal(settings: FloatArray) -> FloatArray:
    """Standard normal variables of characteristics that are uniform from 0 to 10."""
    return np.asarray(scipy.stats.norm.ppf(np.clip(settings / 10, 1e-16, 1 - 1e-16)))


def linear(beta: float) -> Limit:
    return lambda u: beta - u.sum(axis=1) / math.sqrt(u.shape[1])


def curved(radius: float) -> Limit:
    """Failures are outside a sphere: a sum of n squares has a chi squared distribution."""
    return lambda u: radius - np.linalg.norm(u, axis=1)


def rare(limit: Limit, n: int, seed: int = 1, **options: object) -> Risk:
    study = load_study(made_up_study(n), search={"seed": seed}, variation={"a": {"distribution": "uniform"}})
    plant = Plant(study, lambda settings: limit(of_normal(settings)) < 0, lambda settings: limit(of_normal(settings)))
    return risk(study, unsafe="collision", pool=plant, progress=passes_no_end, **{"rare": True, **options})  # type: ignore[arg-type]


def passes_no_end(stage: str, done: int, total: int) -> None:
    assert done <= total, stage


def beta_of(probability: float) -> float:
    return float(-scipy.stats.norm.ppf(probability))


def radius_of(probability: float, n: int) -> float:
    return float(math.sqrt(scipy.stats.chi2.isf(probability, n)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "shape", "n", "probability"),
    [("subset_simulation", "curved", 4, 1e-6), ("cross_entropy", "linear", 8, 1e-6)],
)
def test_analytic_probabilities_over_ten_seeds(method: str, shape: str, n: int, probability: float) -> None:
    limit = linear(beta_of(probability)) if shape == "linear" else curved(radius_of(probability, n))
    estimates = [rare(limit, n, seed, method=method) for seed in range(10)]
    assert {one.method for one in estimates} == {method}
    assert np.mean([one.probability for one in estimates]) == pytest.approx(probability, rel=0.15)
    assert sum(one.interval[0] <= probability <= one.interval[1] for one in estimates) >= 9


@pytest.mark.slow
def test_a_rare_failure_its_interval_and_its_most_probable_point() -> None:
    """The design point of a plane at the distance beta has components beta / sqrt(n)."""
    estimate = rare(linear(beta_of(1e-5)), 3)
    assert estimate.method == "subset_simulation"
    assert estimate.interval[0] <= 1e-5 <= estimate.interval[1]
    assert estimate.remark == ""
    assert estimate.design_point is not None
    point = of_normal(np.array([list(estimate.design_point.values())]))[0]
    assert np.linalg.norm(point) == pytest.approx(beta_of(1e-5), rel=0.05)
    assert point == pytest.approx(beta_of(1e-5) / math.sqrt(3), rel=0.25)
    assert estimate.of_fleet(1000) == pytest.approx(1 - (1 - estimate.probability) ** 1000)
    assert json.dumps(rare(linear(beta_of(1e-5)), 3).to_dict()) == json.dumps(estimate.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_where_no_failure_is_within_reach_a_number_comes_out_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenTURNS raises an error for a probability below the smallest that it estimates, and for samples without any
    failure.
    """
    for name in ("REPEATS", "VERY_RARE_REPEATS"):
        monkeypatch.setattr(rare_failures, name, 1)
    beyond = rare(linear(9.0), 2, method="subset_simulation")
    assert (beyond.method, beyond.probability) == ("subset_simulation", 0)
    assert "found no failure" in beyond.remark
    assert beyond.interval[1] == pytest.approx(1 - 0.025**0.001), "what the first 1000 vehicles show"
    monkeypatch.setattr(compute, "is_plateau", lambda responses: False)
    flat = rare(lambda u: np.select([u[:, 0] > end for end in (6, 3, 2, 1)], [-1, 1, 2, 3], 5.0), 2)
    assert (flat.method, "a plateau before failures" in flat.remark) == ("monte_carlo", True)
    lost = rare(lambda u: np.where(u[:, 0] > 9.0, -1.0, 5.0 + 0.001 * u[:, 1]), 2, method="cross_entropy")
    assert (lost.method, lost.failures) == ("monte_carlo", 0)
    assert "lost all failures" in lost.remark


def test_a_share_of_the_domain_is_counted_whatever_is_installed() -> None:
    """Without [variation] it is no probability, and the shares of `risk`, `rules` and a report are counted on the same
    vehicles.
    """
    study = made_up_study(2)
    assert (
        risk(study, unsafe="collision", pool=Plant(study, lambda rows: rows[:, 0] > 9.99), samples=3000).method
        == "monte_carlo"
    )


@pytest.mark.slow
def test_auto_chooses_and_monte_carlo_stays_where_it_is_asked_for() -> None:
    assert rare(linear(beta_of(1e-4)), 2, rare=False).method == "subset_simulation"
    assert rare(linear(beta_of(1e-4)), 2, rare=False, method="monte_carlo").method == "monte_carlo"
    many = rare(linear(beta_of(5e-3)), 2, rare=False, samples=100_000)
    assert (many.method, many.samples) == ("monte_carlo", 100_000), "so many show 500 failures by themselves"
    with pytest.raises(InputError, match="method"):
        rare(linear(3.0), 2, method="subset")
