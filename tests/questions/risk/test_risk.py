"""Shares, probabilities and rules: against analytic volumes, moments, Ishigami's function, a linear
model and regions that are known.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.random import default_rng

from safevar_sumo import explain, risk, rules
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.answer import HIGH, LOW, Answer
from safevar_sumo.questions.indices import OUTPUTS
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.over_sets import SETS_STAGE, VEHICLES, SharesOverSets
from safevar_sumo.questions.risk import influence_in_words
from safevar_sumo.questions.rules import SAMPLED_STAGE
from safevar_sumo.questions.sampling import clopper_pearson, share_with_interval
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, InlinePool
from tests.support.made_up_studies import (
    ONE_TEST,
    Plant,
    Region,
    box,
    everywhere,
    made_up_study,
    nowhere,
    two_metres,
)

pytestmark = pytest.mark.usefixtures("made_up_studies")


def of(region: Region, **options: Any) -> Answer:
    study = made_up_study(2)
    return risk(study, unsafe="collision", pool=Plant(study, region), **options)


@pytest.mark.parametrize(
    ("region", "volume"), [(box, 0.09), (nowhere, 0.0), (everywhere, 1.0)]
)
def test_the_interval_holds_the_analytic_volume(region: Region, volume: float) -> None:
    numbers = of(region, samples=8000, confidence=0.999).numbers
    low, high = numbers["interval"]
    assert low <= volume <= high
    assert high - low < 0.03
    assert numbers["probability"] == numbers["failures"] / 8000


def test_no_failure_says_how_many_vehicles_would_show_a_rare_one() -> None:
    """And that nothing decides: all vehicles of the plant have one safety degree."""
    answer = of(nowhere, samples=200, confidence=0.9)
    verdict = answer.verdict
    (told,) = re.findall(
        r"at most 0\.01 %, ([\d,]+) sampled vehicles are needed, and all", verdict
    )
    needed = int(told.replace(",", ""))
    highest = [clopper_pearson(0, number, 0.9)[1] for number in (needed - 1, needed)]
    assert highest[1] <= 1e-4 < highest[0]
    assert "the safety degree is the same for all sampled vehicles" in verdict
    assert "shares of the variance" not in answer.render("text"), (
        "a table without a share"
    )
    assert "No sampled vehicle is unsafe" not in of(box, samples=200).verdict


def ishigami(settings: FloatArray) -> FloatArray:
    x = (settings - 5) / 5 * math.pi
    return (
        np.sin(x[:, 0])
        + 7 * np.sin(x[:, 1]) ** 2
        + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    )


class MeasuredPlant(Plant):
    """A pool in which the metric `tit` is Ishigami's function, and `tet` undefined somewhere."""

    def evaluate(self, settings: FloatArray) -> Evaluations:
        evaluations = super().evaluate(settings)
        values = ishigami(settings)
        measured = {"tit": values, "tet": np.where(settings[:, 0] > 5, np.nan, values)}
        return dataclasses.replace(
            evaluations, metrics={**evaluations.metrics, **measured}
        )


@pytest.mark.parametrize(
    ("unsafe", "degree", "measure"),
    [
        ("collision", ishigami, "the safety degree"),
        ("tit > 100", two_metres, "tit"),
        ("tet > 100", ishigami, "the safety degree"),
    ],
)
def test_sobol_indices_of_ishigamis_function(
    unsafe: str, degree: Callable[[FloatArray], FloatArray], measure: str
) -> None:
    """Analytic values of Saltelli et al., Global Sensitivity Analysis (2008), for a = 7, b =
    0.1. The criterion's measure varies, or the safety degree where the measure is undefined.
    """
    study = made_up_study(3)
    answer = risk(
        study, unsafe=unsafe, samples=100, pool=MeasuredPlant(study, nowhere, degree)
    )
    assert f"of the variance of {measure} (" in answer.verdict
    assert ("tit: total" in answer.render("text")) is (measure == "tit")
    table = answer.tables["sensitivity"]
    frame = table.set_index("characteristic")
    assert frame["degree_first"].to_dict() == pytest.approx(
        {"a": 0.3139, "b": 0.4424, "c": 0.0}, abs=0.05
    )
    assert frame["degree_total"].to_dict() == pytest.approx(
        {"a": 0.5576, "b": 0.4424, "c": 0.2437}, abs=0.05
    )
    assert (frame["degree_first_low"] < frame["degree_first"]).loc[["a", "b"]].all()
    degrees = frame.filter(regex="degree").to_numpy()
    assert np.all((degrees >= 0) & (degrees <= 1))
    assert frame["unsafe_total"].isna().all()
    assert table["characteristic"].iloc[0] == "a", "what decides most stands first"


def test_an_undefined_measure_is_counted_without_the_collisions() -> None:
    """`tet` is undefined in one half, of which 9 % of all vehicles collide."""
    study = made_up_study(3)
    plant = MeasuredPlant(study, box)
    verdict = risk(study, unsafe="tet > 100", samples=400, pool=plant).verdict
    told = re.search(
        r"tet is undefined, without a collision, in ([\d,]+) of ([\d,]+) sim", verdict
    )
    assert told is not None
    undefined, simulated = (int(text.replace(",", "")) for text in told.groups())
    assert undefined / simulated == pytest.approx(0.5 - 0.09, abs=0.02)


def test_first_order_indices_of_constrained_characteristics() -> None:
    """Y = a, where a + b is at most 10: knowing b leaves a uniform between 0 and 10 - b, whose mean
    has a quarter of the variance. Sobol's design does not exist, and total indices are undefined.
    """
    constraint = {"sum": {"a": 1.0, "b": 1.0}, "at_most": 10.0}
    study = load_study(made_up_study(3), constraints=[constraint], search={"seed": 0})
    plant = Plant(study, nowhere, lambda settings: settings[:, 0])
    answer = risk(study, unsafe="collision", samples=4000, pool=plant)
    frame = answer.tables["sensitivity"].set_index("characteristic")
    assert frame["degree_first"].to_dict() == pytest.approx(
        {"a": 1.0, "b": 0.25, "c": 0.0}, abs=0.06
    )
    assert frame["degree_total"].isna().all()
    first, again = (
        risk(study, unsafe="collision", samples=250, pool=plant) for _ in range(2)
    )
    pd.testing.assert_frame_equal(
        first.tables["sensitivity"], again.tables["sensitivity"]
    )


def drawn(**variation: dict[str, Any]) -> FloatArray:
    study = load_study(made_up_study(2), variation=variation)
    return VariationModel(study).settings(default_rng(1).random((20_000, 2)))


def test_every_distribution_has_its_moments() -> None:
    normal, triangular = drawn(
        a={"distribution": "normal", "deviation": 0.5, "mean": 6.0},
        b={"distribution": "triangular", "upper": 8.0},
    ).T
    assert (normal.mean(), normal.std()) == pytest.approx((6.0, 0.5), abs=0.02)
    assert (triangular.mean(), triangular.max()) == pytest.approx(
        (13 / 3, 8.0), abs=0.1
    )
    fixed, uniform = drawn(
        a={"distribution": "fixed", "value": 7.0},
        b={"distribution": "uniform", "lower": 2.0},
    ).T
    assert set(fixed) == {7.0}
    assert (uniform.min(), uniform.mean()) == pytest.approx((2.0, 6.0), abs=0.05)
    tight = drawn(a={"distribution": "normal", "deviation": 50.0})[:, 0]
    assert tight.min() >= 0
    assert tight.max() <= 10


def rules_of(region: Region, n: int = 4, **options: Any) -> Answer:
    study = made_up_study(n)
    return rules(study, unsafe="collision", pool=Plant(study, region), **options)


def test_a_box_is_one_rule_of_its_two_conditions() -> None:
    answer = rules_of(box)
    (row,) = answer.tables["rules"].itertuples()
    assert row.rule == "a above 7 N m and b below 3 N m"
    assert (row.density, row.coverage) == pytest.approx((1, 1), abs=0.02)
    assert row.density_low <= row.density <= row.density_high
    assert answer.numbers["failures"] / answer.numbers["samples"] == pytest.approx(
        0.09, abs=0.005
    )
    assert "ranges of values): a above 7 N m and b below 3 N m. " in answer.verdict


def test_rules_draw_as_the_variation_says() -> None:
    """A characteristic that is always 8 of 0 to 10 decides nothing, and the share is that of
    `risk`.
    """
    study = load_study(
        made_up_study(3), variation={"a": {"distribution": "fixed", "value": 8.0}}
    )
    by_rules, by_risk = (
        ask(study, unsafe="collision", samples=1000, pool=Plant(study, box))
        for ask in (rules, risk)
    )
    assert by_rules.numbers["failures"] == by_risk.numbers["failures"]
    assert (
        "of the 1,000 vehicles that were sampled as the study states"
        in by_rules.verdict
    )
    (rule,) = by_rules.tables["rules"]["rule"]
    assert rule.startswith("b below 3")


@pytest.mark.parametrize(
    ("of_b", "said"),
    [
        (
            0.49,
            "A has the largest influence: it causes 60 % of the variance of the safety degree (",
        ),
        (
            0.51,
            "uncertain. A causes 60 % of the variance of the safety degree (95 % confidence",
        ),
    ],
)
def test_only_an_interval_above_all_others_decides(of_b: float, said: str) -> None:
    """And what decides between safe and unsafe is unknown without shares."""
    frame = pd.DataFrame(
        {
            "characteristic": ["a", "b"],
            "degree_total": [0.6, 0.4],
            f"degree_total{LOW}": [0.5, 0.3],
            f"degree_total{HIGH}": [0.7, of_b],
            "unsafe_total": [1.37, 0.0],
        }
    )
    names = {"a": "a", "b": "b"}
    (told,) = influence_in_words(frame, OUTPUTS["degree"], 120, 0.95, names)
    assert said in told.text
    frame["unsafe_total"] = np.nan
    _, unknown = influence_in_words(frame, "", 1, 0.95, names)
    assert "at least 100 unsafe and 100 safe vehicles are needed" in unknown.text


def test_nothing_everything_and_too_little() -> None:
    assert rules_of(nowhere).tables["rules"].empty
    (row,) = rules_of(everywhere).tables["rules"].itertuples()
    assert (row.rule, row.density, row.coverage) == ("everywhere", 1.0, 1.0)
    few = rules_of(lambda settings: (settings > 9.5).all(axis=1), n=2, samples=400)
    assert few.tables["rules"].empty
    assert "No region can be found, because the search has only" in few.verdict


def test_a_rule_that_may_be_due_to_chance_is_in_no_verdict() -> None:
    answer = rules_of(
        lambda settings: np.sin(1e6 * settings[:, 0]) > 0.7, n=2, samples=400
    )
    table = answer.tables["rules"]
    assert (" lie in this region" in answer.verdict) == (
        table["density_low"] > (answer.numbers["failures"] / answer.numbers["samples"])
    ).any()


@pytest.mark.parametrize(
    "constraints", [[], [{"sum": {"a": 1.0, "b": 1.0}, "at_most": 12.0}]]
)
def test_the_share_of_unsafe_vehicles_is_that_of_risk(
    constraints: list[dict[str, Any]],
) -> None:
    """The same vehicles in both, the first ones of a longer sequence in a shorter one: each
    estimate lies in the other's interval.
    """
    study = load_study(made_up_study(2), constraints=constraints)
    few, many, estimated = (Plant(study, box) for _ in range(3))
    numbers = {
        samples: rules(study, unsafe="collision", pool=pool, samples=samples).numbers
        for samples, pool in ((400, few), (1000, many))
    }
    estimate = risk(study, unsafe="collision", pool=estimated, samples=1000).numbers
    assert few.seen < many.seen <= estimated.seen
    assert numbers[1000]["share"] == estimate["probability"]
    assert numbers[1000]["interval"] == pytest.approx(estimate["interval"])
    for one, other in ((400, 1000), (1000, 400)):
        low, high = numbers[one]["interval"]
        assert low < numbers[other]["share"] < high


@SLOW
def test_risk_rules_and_explain_simulate_the_same_vehicles_with_each_parameter_set() -> (
    None
):
    spread = {name: sets[:3] for name, sets in load_study("wear").spread.items()}
    study = load_study("wear", spread=spread, **ONE_TEST)
    vehicles = VariationModel(study).draw(VEHICLES, default_rng(study.search.seed))
    unsafe = np.array(
        [
            drive_and_score(assemble(one), vehicles, with_originals=False).collided
            for one in studies_of_sets(study)
        ]
    )
    options = {"unsafe": "collision", "pool": InlinePool()}
    by_rules = rules(study, samples=600, **options)
    for answer in (
        risk(study, samples=500, **options),
        by_rules,
        explain(study, **options),
    ):
        assert answer.numbers["by_set"] == unsafe.mean(axis=1).tolist()
        assert answer.numbers["by_set_intervals"] == [
            list(clopper_pearson(count, VEHICLES)) for count in unsafe.sum(axis=1)
        ]
    table = by_rules.tables["rules"]
    assert len(table)
    assert (table["density_least"] <= table["density"]).all()
    assert (table["density"] <= table["density_greatest"]).all()


@pytest.mark.parametrize(
    ("failing", "least", "greatest"),
    [
        (
            (10, 40, 60),
            "2.5 % (set 0, 95",
            "15 % (95 % confidence interval 12 to 19 %)",
        ),
        (
            (10, 20, 60),
            "2.5 % (95",
            "15 % (set 2, 95 % confidence interval 12 to 19 %)",
        ),
        (
            (9, 9, 9),
            "is 2.2 % (95 % confidence interval 1 to 4.2 %) in each of",
            "the 3",
        ),
    ],
)
def test_a_parameter_set_is_named_where_its_interval_leaves_the_others_out(
    failing: tuple[int, ...], least: str, greatest: str
) -> None:
    shares = np.array([[share_with_interval(count, VEHICLES)] for count in failing])
    ((_, words),) = SharesOverSets(load_study("wear"), shares).sentences()
    assert least in words
    assert greatest in words


@SLOW
def test_the_other_parameter_sets_are_planned() -> None:
    """Progress counts them from the beginning. A number of simulations that suffices for all but
    these is a bound, within which the own set answers alone.
    """
    study = load_study("wear", **ONE_TEST)
    shown = list[tuple[str, int, int]]()
    rules(
        study,
        samples=100,
        unsafe="collision",
        pool=InlinePool(),
        progress=lambda *one: shown.append(one),
    )
    expected = 100 + 12 * 100
    assert {total for phase, _, total in shown if phase == SAMPLED_STAGE} == {expected}
    assert shown[-1][0] == SETS_STAGE
    assert shown[-1][1] <= expected
    bounded = risk(study, samples=400, simulations=5190, pool=InlinePool())
    assert "Other parameter sets (alternative calibrations) were not" in bounded.verdict


def test_the_first_sentence_of_rules_says_what_lies_outside_of_the_regions() -> None:
    """Unsafe are a large corner, which becomes a region, and 2 % of the rest, which does not."""

    def region(settings: FloatArray) -> BoolArray:
        corner = (settings[:, 0] > 6) & (settings[:, 1] > 6)
        # The last digits of a value say nothing about the rest of the vehicle.
        return corner | (settings[:, 0] * 1000 % 1 < 0.02)

    answer = rules_of(region, samples=4000)
    outside = round(100 * (1 - answer.tables["rules"]["coverage"].sum()))
    assert answer.verdict.startswith(
        f"{outside} % of all unsafe vehicles lie outside of the"
    )
    assert 5 < outside < 15


def test_sets_without_an_unsafe_vehicle_are_told_by_a_count() -> None:
    over_sets = SharesOverSets(load_study("smoke"), np.zeros((20, 1, 3)))
    (sentence,) = over_sets.sentences()
    assert "None of these vehicles is unsafe." in sentence.text
    assert "0 %" not in sentence.text
