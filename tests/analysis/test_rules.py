"""Rules against regions that are known."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from safevar_sumo import risk, rules
from safevar_sumo.analysis.rules.compute import Rule, Rules
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
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


def of(region: Region, n: int = 4, **options: Any) -> Rules:
    study = made_up_study(n)
    return rules(study, unsafe="collision", pool=Plant(study, region), **options)


def test_a_box_is_one_rule_of_its_two_conditions() -> None:
    result = of(box)
    (rule,) = result.rules
    assert rule.limits == {"a": (pytest.approx(7, abs=0.02), None), "b": (None, pytest.approx(3, abs=0.02))}
    assert rule.density == pytest.approx(1, abs=0.02)
    assert rule.coverage == pytest.approx(1, abs=0.02)
    assert result.unsafe_share == pytest.approx(0.09, abs=0.005)
    assert rule.density_interval is not None
    assert rule.density_interval[0] <= rule.density <= rule.density_interval[1]


def test_two_islands_are_two_rules() -> None:
    first, second = sorted((rule.limits["a"] for rule in of(two_islands).rules), key=lambda ends: ends[0] or 0)
    assert first == (pytest.approx(6.5, abs=0.02), pytest.approx(7, abs=0.02))
    assert second == (pytest.approx(9, abs=0.02), None)


@pytest.mark.slow
def test_a_region_that_is_no_box_is_covered_with_honest_densities() -> None:
    result = of(diagonal_band, n=2)
    fresh = np.random.default_rng(5).uniform(0, 10, (20_000, 2))
    assert result.rules
    for rule in result.rules:
        inside = np.ones(len(fresh), dtype=bool)
        for name, (low, high) in rule.limits.items():
            values = fresh[:, "ab".index(name)]
            inside &= (values >= (low or 0)) & (values <= (10 if high is None else high))
        assert rule.density_interval is not None
        assert rule.density_interval[0] - 0.1 <= diagonal_band(fresh)[inside].mean() <= rule.density_interval[1] + 0.1


def test_a_rare_box_of_four_characteristics_is_found() -> None:
    result = of(lambda settings: (settings[:, :4] > 7.8).all(axis=1), n=8)
    assert result.unsafe_share == pytest.approx(0.22**4, abs=0.001)
    assert set(result.rules[0].limits) <= set("abcd")
    assert (result.rules[0].density or 0) > 0.4


def test_nothing_everything_and_too_little() -> None:
    assert of(nowhere).to_dict() == []
    (rule,) = of(everywhere).rules
    assert (dict(rule.limits), rule.density, rule.coverage) == ({}, 1.0, 1.0)
    few = of(lambda settings: (settings > 9.5).all(axis=1), n=2, samples=400)
    assert few.rules == []
    assert "the command rules --samples N" in few.remark


def test_a_rule_is_denser_than_a_share_below_its_interval() -> None:
    """8 of 10: Clopper and Pearson have 44.4 to 97.5 %."""
    rule = Rule({"a": (7.0, None)}, inside=10, unsafe_inside=8, unsafe_everywhere=20, confidence=0.95)
    assert rule.density_interval == pytest.approx((0.444, 0.975), abs=5e-4)
    assert [rule.is_denser_than(share) for share in (0.4, 0.5, 0.9)] == [True, False, False]


def test_the_promised_record_the_same_again_and_in_words() -> None:
    first, again = (of(box), of(box))
    assert json.dumps(first.to_dict(), allow_nan=False) == json.dumps(again.to_dict(), allow_nan=False)
    assert repr(first).endswith("settings, 1 rules>")
    (record,) = first.to_dict()
    assert list(record) == ["conditions", "density", "coverage", "density_interval", "coverage_interval"]
    assert [list(condition) for condition in record["conditions"]] == [["characteristic", "at_least", "at_most"]] * 2
    frame = first.to_frame().astype(object)
    assert frame.where(frame.notna(), None)[list(record["conditions"][0])].to_dict("records") == record["conditions"]
    assert frame["rule"].tolist() == [0, 0]
    result = first.rules[0].in_words(CharacteristicSet.of(first.study.vehicle.characteristics), first.unsafe)
    assert result.startswith("a above 7 N m and b below 3 N m, the others anywhere: collides in 100 % (")


@pytest.mark.parametrize("constraint", [None, {"sum": {"a": 1.0, "b": 1.0}, "at_most": 12.0}])
def test_the_share_of_unsafe_vehicles_is_that_of_risk(constraint: dict[str, Any] | None) -> None:
    """The same vehicles in both, the first ones of a longer sequence in a shorter one: each estimate lies in the
    other's interval.
    """
    study = made_up_study(2)
    study = load_study(study, constraints=[constraint]) if constraint else study
    asked = {number: Plant(study, box) for number in (400, 1000)}
    shares = {number: rules(study, unsafe="collision", pool=pool, samples=number) for number, pool in asked.items()}
    estimate = risk(study, unsafe="collision", pool=(plant := Plant(study, box)), samples=1000, method="monte_carlo")
    assert asked[400].seen < asked[1000].seen <= plant.seen
    assert (shares[1000].unsafe_share, shares[1000].unsafe_interval) == (
        estimate.probability,
        pytest.approx(estimate.interval),
    )
    for one, other in ((400, 1000), (1000, 400)):
        low, high = shares[one].unsafe_interval
        assert low < shares[other].unsafe_share < high


def test_rules_say_over_what_they_hold() -> None:
    """In a rule all characteristics vary, in a tolerance one alone: otherwise their limits contradict each other."""
    printed = " ".join(map(str, of(box).sentences()))
    assert "a above 7 N m and b below 3 N m, the others anywhere: collides in" in printed
    assert (
        "all characteristics vary together over the whole domain; how far one may go while all others stay "
        "as in the original"
    ) in printed
    assert "% of 16384 vehicles drawn evenly over the whole domain (" in printed
