"""The filter and the two objectives of change, against the numbers of the method (sections 2 and 3)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safevar_sumo.errors import InputError
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

SUN = CharacteristicSet.of(load_study("sun").vehicle.characteristics)


def one(lower: float, original: float, upper: float) -> Characteristic:
    return Characteristic(name="c", unit="-", original=original, lower=lower, upper=upper)


@pytest.mark.parametrize(("lower", "upper", "threshold"), [
    (2040, 2700, 13.2),  # the worked example of the paper: mass
    (0, 1000, 10), (0, 999, 0.02 * 999), (0, 100, 2), (0, 99, 0.04 * 99), (0, 1, 0.04), (0, 0.5, 0.04),
])
def test_threshold_is_a_share_of_the_domains_width(lower: float, upper: float, threshold: float) -> None:
    assert one(lower, upper, upper).threshold == pytest.approx(threshold)


settings_in_domain = arrays(float, (5, 12), elements=st.floats(0, 1)).map(lambda share: SUN.lower + share * (SUN.upper - SUN.lower))


@given(settings_in_domain)
def test_filter_is_idempotent_and_keeps_or_restores(settings: np.ndarray) -> None:
    filtered = SUN.filter(settings)
    assert np.array_equal(SUN.filter(filtered), filtered)
    assert np.all((filtered == settings) | (filtered == SUN.original))


@given(settings_in_domain)
def test_objectives_of_change_agree_with_a_loop(settings: np.ndarray) -> None:
    filtered = SUN.filter(settings)
    for row, largest, number in zip(filtered, SUN.largest_change(filtered), SUN.number_changed(filtered), strict=True):
        relative = [abs(member.original - value) / member.original for member, value in zip(SUN, row, strict=True)]
        assert largest == max(relative)
        assert number == sum(value > 0 for value in relative)


@pytest.mark.parametrize("value", [1.0, 5000.0, float("nan"), float("inf")])
def test_a_value_outside_the_domain_is_refused(value: float) -> None:
    with pytest.raises(InputError, match=r"mass = .*\nexpected: a number in \[2040, 2700\] kg"):
        SUN.setting({"mass": value}, "--set")
    with pytest.raises(InputError, match=r"\nexpected: a number in \[[\d.]+, [\d.]+\]$"):
        SUN.setting({"tireFric": -abs(value)}, "--set")


def test_an_unknown_characteristic_is_refused() -> None:
    with pytest.raises(InputError, match="gearSwitchTime"):
        SUN.setting({"weight": 2000.0}, "--set")


def test_a_change_of_just_the_threshold_is_noise() -> None:
    """Numbers that are exact in binary: 2 % of a width of 100."""
    exact = CharacteristicSet((one(0, 50, 100),))
    assert exact.filter(np.array([[52.0], [48.0], [52.5], [47.5]])).ravel().tolist() == [50, 50, 52.5, 47.5]


@pytest.mark.parametrize("value", [2040.0, 2700.0])
def test_the_ends_of_a_domain_belong_to_it(value: float) -> None:
    assert SUN.setting({"mass": value}, "--set")[SUN.names.index("mass")] == value
