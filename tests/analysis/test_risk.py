"""Probabilities against analytic volumes, distributions against their moments, sensitivity against Ishigami's
function.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from safevar_sumo import risk
from safevar_sumo.analysis.risk.answer import Risk
from safevar_sumo.analysis.risk.variation import VariationModel
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import load_study
from safevar_sumo.study.variation import Distribution
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


@pytest.mark.parametrize(("region", "share"), [(box, 0.09), (lambda rows: rows[:, 0] < 5, 0.5), (everywhere, 1.0)])
def test_the_coefficient_of_variation_is_that_of_a_binomial_share(region: Region, share: float) -> None:
    assert of(region, samples=8000).coefficient_of_variation == pytest.approx(
        math.sqrt((1 - share) / (8000 * share)), rel=0.05
    )


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
    assert result.sensitivity is not None
    frame = result.sensitivity.set_index("characteristic")
    assert frame["first_order"].to_dict() == pytest.approx({"a": 0.3139, "b": 0.4424, "c": 0.0}, abs=0.05)
    assert frame["total"].to_dict() == pytest.approx({"a": 0.5576, "b": 0.4424, "c": 0.2437}, abs=0.05)
    assert (frame["first_order_lower"] < frame["first_order"]).all()
    assert result.sensitivity_of_unsafe is not None
    assert result.sensitivity_of_unsafe["total"].isna().all()
    outputs = result.to_frame().pivot(index="characteristic", columns="output", values="total")
    assert outputs["safety_degree"].to_dict() == frame["total"].to_dict()
    assert outputs["unsafe"].isna().all()


@pytest.mark.parametrize(
    ("variation", "says", "warns"),
    [
        ({}, "Share of the domain that is unsafe: 0.", True),
        ({"a": {"distribution": "normal", "deviation": 1.0}}, "Probability 0.", False),
    ],
)
def test_a_share_of_the_domain_is_not_called_a_probability(variation: dict[str, Any], says: str, warns: bool) -> None:
    study = msgspec.structs.replace(made_up_study(2), variation=msgspec.convert(variation, dict[str, Distribution]))
    printed = list(map(str, risk(study, unsafe="collision", samples=200, pool=Plant(study, box)).sentences()))
    assert any(says in part for part in printed)
    assert any("this is not a probability in the field" in part for part in printed) == warns


def test_words_of_a_risk_claim_nothing_that_is_not_there() -> None:
    """Everything varies as specified, so there are no others; no fleet is certain to fail; 99.9 % is not 100 %."""
    normal = {"distribution": "normal", "deviation": 1.0}
    variation = msgspec.convert({"a": normal, "b": normal}, dict[str, Distribution])
    study = msgspec.structs.replace(made_up_study(2), variation=variation)
    result = risk(study, unsafe="collision", samples=200, confidence=0.999, pool=Plant(study, box))
    result = replace(result, probability=0.009)
    printed = " ".join(map(str, result.sentences()))
    assert "They vary as the study specifies: a normal; b normal." in printed
    assert "at least one is unsafe with probability above 0.99." in printed
    assert "with 99.9 % confidence" in printed


def test_the_promised_record_and_the_same_again() -> None:
    assert re.fullmatch(r"<Risk of [\w-]+, unsafe collision: 0\.\d+ \(0\.\d+ to 0\.\d+\)>", repr(of(box, samples=500)))
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
    study = load_study(made_up_study(2), correlations=[{"between": ["a", "b"], "value": 0.8}])
    result = risk(study, unsafe="collision", samples=100, pool=Plant(study, box))
    assert result.to_dict()["sensitivity"] == []
    assert result.to_frame().empty


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"variation": {"wings": {"distribution": "fixed"}}}, "variation.wings"),
        ({"variation": {"mass": {"distribution": "normal", "deviation": -1}}}, "deviation"),
        (
            {"variation": {"mass": {"distribution": "normal", "deviation": 1, "mean": 9999}}},
            "variation.mass.mean = 9999",
        ),
        (
            {"variation": {"mass": {"distribution": "uniform", "lower": 2600, "upper": 2100}}},
            "lower = 2600 and upper = 2100",
        ),
        (
            {"variation": {"mass": {"distribution": "triangular", "lower": 2100, "mode": 2050}}},
            "variation.mass.mode = 2050",
        ),
        ({"variation": {"mass": {"distribution": "cauchy"}}}, "cauchy"),
        ({"correlations": [{"between": ["mass", "wings"], "value": 0.5}]}, "'wings'"),
        ({"correlations": [{"between": ["mass", "mass"], "value": 0.5}]}, "two different"),
        ({"correlations": [{"between": ["mass", "radius"], "value": 1.5}]}, "correlations"),
        (
            {
                "correlations": [
                    {"between": pair, "value": -0.9}
                    for pair in (["mass", "radius"], ["mass", "tireFric"], ["radius", "tireFric"])
                ]
            },
            "contradict each other",
        ),
        (
            {
                "correlations": [
                    {"between": ["mass", "radius"], "value": 0.5},
                    {"between": ["radius", "mass"], "value": -0.5},
                ]
            },
            "radius and mass are given twice, with 0.5 and -0.5",
        ),
        ({"correlations": [{"between": ["mass", "radius"], "value": 0.5}] * 2}, "are given twice"),
        (
            {"variation": {"mass": {"distribution": "normal", "deviation": 1e300}}},
            "variation.mass.deviation = 1e+300\nexpected: at most 66000",
        ),
        ({"variation": {"mass": {"distribution": "lognormal", "sigma": 1e300}}}, "variation.mass.sigma"),
    ],
)
def test_impossible_distributions_are_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says.replace("[", r"\[").replace("+", r"\+")):
        VariationModel(load_study("smoke", **changes))
