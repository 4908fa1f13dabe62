"""Constraints of two values as closed forms, and the digits of values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.study import PHASE, CharacteristicTable, Constraint
from safevar_sumo.vehicles import FeasibleRegion, region_of
from safevar_sumo.vehicles.region import N_REPAIR_SHARES, REJECTIONS


def region(original: float = 5.0, **bounds: float) -> FeasibleRegion:
    """Two values from 0 to 10, whose sum has bounds."""
    smoke = load_study("smoke")
    row = CharacteristicTable(unit="N", original=original, lower=0.0, upper=10.0)
    vehicle = replace(smoke.vehicle, characteristics={"a": row, "b": row})
    constraint = Constraint(sum={"a": 1.0, "b": 1.0}, **bounds)
    return region_of(replace(smoke, vehicle=vehicle, constraints=(constraint,)))


def test_a_repaired_setting_is_the_last_feasible_one_on_the_way_from_the_original() -> (
    None
):
    """The sum of 10 grows to 20 on the way, or falls to 0."""
    settings = np.array([[10.0, 10.0], [9.0, 3.0], [0.0, 0.0], [10.0, 0.0]])
    repaired = region(at_most=12.0, at_least=9.0).repaired(settings)
    for row, share in (0, 2 / 10), (2, 1 / 10):
        steps = np.floor(share * N_REPAIR_SHARES)
        assert repaired[row] == pytest.approx(
            5 + (settings[row] - 5) * steps / N_REPAIR_SHARES
        )
    assert repaired[[1, 3]].tolist() == settings[[1, 3]].tolist()


@pytest.mark.parametrize(("least", "is_refused"), [(19.2, False), (19.6, True)])
def test_constraints_that_hardly_any_setting_satisfies_are_refused(
    least: float, is_refused: bool
) -> None:
    """Above the least sum is a triangle of 0.32 % or of 0.08 % of all settings."""
    if not is_refused:
        assert region(10.0, at_least=least)
        return
    with pytest.raises(InputError, match="fewer than 2 in 1,000"):
        region(10.0, at_least=least)


def test_draws_end_where_no_setting_is_feasible() -> None:
    bound = region(at_most=12.0)
    drawn = list[int]()

    def draw(number: int) -> Any:
        drawn.append(number)
        return np.full((number, 2), 9.0)

    assert len(bound.draw_feasible(draw, 3)) == 0
    assert 3 * REJECTIONS <= sum(drawn) < 6 * REJECTIONS + 3


def test_only_the_phase_of_an_encounter_has_its_own_digits() -> None:
    """All others have a quarter of a thousandth of their width, of 10 and of 200."""
    (item, _) = region(0.0, at_most=20.0).characteristics
    axis = replace(item, is_scenario=True)
    wide = replace(axis, upper=200.0)
    assert replace(item, name=PHASE).digits == axis.digits == item.digits
    assert replace(axis, name=PHASE).digits == replace(wide, name=PHASE).digits == 4
    assert wide.digits < axis.digits
