"""Intervals, planes and joint factors against regions that are known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_regions import Plant, Region, box, diagonal_band, everywhere, made_up_study, nowhere, two_islands

from safevar_sumo.answers import Tolerance, tolerance
from safevar_sumo.errors import InputError


def of(n: int, region: Region, pairs: bool = False, unsafe: str | None = "collision") -> Tolerance:
    study = made_up_study(n)
    return tolerance(study, unsafe=unsafe, pairs=pairs, pool=Plant(study, region, lambda rows: 8 - np.abs(rows[:, 0] - 5)))


def test_islands_and_the_safe_interval_around_the_original() -> None:
    first, second = of(2, two_islands).alone
    assert first.safe == (0.0, pytest.approx(6.5, abs=1e-4))
    assert first.safe[1] <= 6.5
    assert [pytest.approx(interval, abs=1e-4) for interval in [(6.5, 7.0), (9.0, 10.0)]] == first.unsafe
    assert first.margins == (pytest.approx(3.0), pytest.approx(6.5, abs=1e-3))
    assert (second.safe, second.unsafe) == ((0.0, 10.0), [])
    assert len(first.profile) > 201


@settings(max_examples=30)
@given(ends=st.lists(st.floats(0, 10), min_size=2, max_size=2).map(sorted))
def test_any_interval_is_found_that_is_as_wide_as_two_values_are_apart(ends: list[float]) -> None:
    low, high = ends
    (alone,) = of(1, lambda rows: (rows[:, 0] >= low) & (rows[:, 0] <= high)).alone
    if high - low > 0.05:
        assert alone.unsafe == [(pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))]
    if low <= 5 <= high:
        assert alone.safe is None
    elif high - low > 0.05:
        assert alone.safe == ((0.0, pytest.approx(low, abs=1e-4)) if low > 5 else (pytest.approx(high, abs=1e-4), 10.0))


def test_a_plane_with_a_box_in_its_corner() -> None:
    told = of(3, box, pairs=True)
    assert told.pairs is not None
    shares = {tuple(member.name for member in pair.characteristics): pair.unsafe_share for pair in told.pairs}
    assert shares == {("a", "b"): pytest.approx(0.09, abs=0.02), ("a", "c"): 0, ("b", "c"): 0}
    first = told.pairs[0]
    assert first.nearest == (pytest.approx(7, abs=0.5), pytest.approx(3, abs=0.5))
    assert box(np.array([first.nearest]))[0]
    assert told.pairs[1].nearest is None
    assert told.verdict == "No single characteristic makes it unsafe, but 1 of 3 pairs: a with b."


def test_a_diagonal_band_is_nearest_where_it_is_nearest() -> None:
    told = of(2, diagonal_band, pairs=True)
    assert told.pairs is not None
    assert told.pairs[0].unsafe_share == pytest.approx(0.06, abs=0.03)
    assert told.pairs[0].nearest == (pytest.approx(8, abs=0.26), pytest.approx(2, abs=0.26))
    assert told.joint.factor == pytest.approx(3 / 5, rel=0.02)


@pytest.mark.parametrize(("region", "n", "factor"), [
    (box, 2, 0.4), (two_islands, 3, 0.3), (nowhere, 4, 1.0), (everywhere, 2, 0.0),
    (lambda rows: np.sum(rows - 5, axis=1) > 12, 4, 0.6)])  # a corner of all four, which no pair reaches
def test_the_joint_factor_ends_before_what_is_unsafe(region: Region, n: int, factor: float) -> None:
    told = of(n, region).joint
    assert told.factor == pytest.approx(factor, rel=0.02)
    assert told.factor <= factor
    assert told.unsafe_at_most == pytest.approx(1 - 0.05 ** (1 / told.samples))


def test_nothing_and_everything() -> None:
    safe, unsafe = of(2, nowhere, pairs=True), of(2, everywhere, pairs=True)
    assert safe.verdict == "No single characteristic and no pair makes it unsafe."
    assert unsafe.verdict == "The original vehicle itself is unsafe."
    assert unsafe.alone[0].safe is None
    assert unsafe.alone[0].unsafe == [(0.0, 10.0)]
    assert unsafe.pairs is not None
    assert unsafe.pairs[0].unsafe_share == pytest.approx(1)


def test_where_nothing_collides_half_of_the_original_is_the_limit() -> None:
    told = of(1, nowhere, unsafe=None)
    assert str(told.unsafe) == "below=4.0"
    assert told.alone[0].safe == (pytest.approx(1.0, abs=1e-4), pytest.approx(9.0, abs=1e-4))


def test_it_is_shown_in_a_line() -> None:
    told = of(2, two_islands)
    assert repr(told) == f"<Tolerance of {told.study.name}, unsafe collision: Unsafe alone: a.>"


def test_the_promised_record() -> None:
    record = json.loads(json.dumps(of(2, two_islands, pairs=True).record(), allow_nan=False))
    assert list(record) == ["study", "unsafe", "alone", "pairs", "joint"]
    assert list(record["alone"][0]) == ["characteristic", "unit", "original", "safe", "unsafe"]
    assert list(record["pairs"][0]) == ["characteristics", "unsafe_share", "nearest"]
    assert list(record["pairs"][0]["nearest"]) == ["a", "b"]
    assert list(record["joint"]) == ["factor", "confidence", "samples"]


def test_one_characteristic_has_no_pair() -> None:
    assert of(1, nowhere, pairs=True).pairs == []


def test_an_unknown_characteristic_is_refused() -> None:
    study = made_up_study(2)
    with pytest.raises(InputError, match="'wings'"):
        tolerance(study, characteristics=["wings"], pool=Plant(study, nowhere))
