"""Rules against regions that are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safevar_sumo import risk, rules
from safevar_sumo.analysis.answer import Answer
from safevar_sumo.study import load_study
from tests.analysis.known_regions import Plant, Region, box, everywhere, made_up_study, nowhere


def rules_of(region: Region, n: int = 4, **options: Any) -> Answer:
    study = made_up_study(n)
    return rules(study, unsafe="collision", pool=Plant(study, region), **options)


def test_a_box_is_one_rule_of_its_two_conditions() -> None:
    answer = rules_of(box)
    (row,) = answer.tables["rules"].itertuples()
    assert row.rule == "a above 7 N m and b below 3 N m"
    assert (row.density, row.coverage) == pytest.approx((1, 1), abs=0.02)
    assert row.density_low <= row.density <= row.density_high
    assert answer.numbers["failures"] / answer.numbers["samples"] == pytest.approx(0.09, abs=0.005)
    assert "Most of them lie where a above 7 N m and b below 3 N m" in answer.verdict


def test_nothing_everything_and_too_little() -> None:
    assert rules_of(nowhere).tables["rules"].empty
    (row,) = rules_of(everywhere).tables["rules"].itertuples()
    assert (row.rule, row.density, row.coverage) == ("everywhere", 1.0, 1.0)
    few = rules_of(lambda settings: (settings > 9.5).all(axis=1), n=2, samples=400)
    assert few.tables["rules"].empty
    assert "--samples N draws more" in few.verdict


def test_a_rule_that_may_be_due_to_chance_is_in_no_verdict() -> None:
    answer = rules_of(lambda settings: np.sin(1e6 * settings[:, 0]) > 0.7, n=2, samples=400)
    table = answer.tables["rules"]
    share = answer.numbers["failures"] / answer.numbers["samples"]
    assert "Most of them" not in answer.verdict or (table["density_low"] > share).any()


@pytest.mark.parametrize("constraint", [None, {"sum": {"a": 1.0, "b": 1.0}, "at_most": 12.0}])
def test_the_share_of_unsafe_vehicles_is_that_of_risk(constraint: dict[str, Any] | None) -> None:
    """The same vehicles in both, the first ones of a longer sequence in a shorter one: each estimate lies in the
    other's interval.
    """
    study = made_up_study(2)
    study = load_study(study, constraints=[constraint]) if constraint else study
    asked = {number: Plant(study, box) for number in (400, 1000)}
    numbers = {size: rules(study, unsafe="collision", pool=pool, samples=size).numbers for size, pool in asked.items()}
    estimate = risk(study, unsafe="collision", pool=(plant := Plant(study, box)), samples=1000).numbers
    assert asked[400].seen < asked[1000].seen <= plant.seen
    assert numbers[1000]["share"] == estimate["probability"]
    assert numbers[1000]["interval"] == pytest.approx(estimate["interval"])
    for one, other in ((400, 1000), (1000, 400)):
        low, high = numbers[one]["interval"]
        assert low < numbers[other]["share"] < high
