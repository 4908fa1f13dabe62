"""Boxes of limits together, and the search for them, against regions that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import falsify
from safevar_sumo.questions.tolerance.alone import AloneSearch
from safevar_sumo.questions.tolerance.scans import scan
from safevar_sumo.questions.tolerance.search import BoxSearch
from safevar_sumo.questions.tolerance.together import CONFIRMATIONS, LimitsTogether
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Limit
from safevar_sumo.vehicles import region_of
from tests.questions.conftest import box_of, made_up_model, made_up_study, nowhere

LINEAR = np.array([1.0, 2.0, 3.0])
"""Weights of a region whose largest box has sides at 10, 7.5 and 5."""


def relative_volume(found: LimitsTogether) -> float:
    return float(np.prod(found.box.upper - found.box.lower)) / 10 ** len(found.box.lower)


def linear(rows: FloatArray) -> BoolArray:
    return (rows - 5) @ LINEAR > 10


@pytest.mark.parametrize(("limits", "largest"), [({}, 0.375), ({"c": Limit(at_most=7)}, 0.315)])
def test_the_box_with_limits_is_nearly_the_largest(
    limits: dict[str, Limit], largest: float
) -> None:
    found = box_of(3, linear, limits)
    assert 0.97 * largest < relative_volume(found) <= largest
    assert (found.box.upper - 5) @ LINEAR <= 10
    assert found.proof.at_most == pytest.approx(1 - 0.05 ** (1 / found.proof.samples))
    assert all(
        found.box.upper["abc".index(name)] == limit.at_most for name, limit in limits.items()
    )


def test_a_box_stays_within_that_of_a_smaller_unsafe_region() -> None:
    """The largest box without the larger region has b up to 7, and needs no limit of a."""

    def pair(rows: FloatArray) -> BoolArray:
        return (rows[:, 0] > 9) & (rows[:, 1] > 7)

    def both(rows: FloatArray) -> BoolArray:
        return pair(rows) | (rows[:, 1] > 7) & (rows[:, 2] > 5.5)

    outer = box_of(3, pair, {})
    alone, inner = box_of(3, both, {}), box_of(3, both, {}, outer=outer)
    ends = [outer.box.upper, alone.box.upper, inner.box.upper]
    assert (ends[1] > ends[0]).any()
    assert (ends[2] <= ends[0]).all()
    assert (inner.box.lower >= outer.box.lower).all()
    assert not both(inner.box.corners(0, 0)).any()
    again = box_of(3, pair, {}, outer=outer)
    assert again.box.upper.tolist() == ends[0].tolist()
    assert again.beyond.keys() == outer.beyond.keys()
    assert box_of(3, pair, {}, outer=outer._replace(box=None)).box is None


def test_no_limit_of_the_box_can_move_out_alone() -> None:
    """By a 50th of its range, or it meets the failure that is named."""
    found = box_of(3, linear, {})
    ends = [column for column in range(3) if found.box.upper[column] < 10]
    assert len(ends) >= 2
    for column in ends:
        setting = found.beyond[1, column]
        assert linear(setting[np.newaxis])[0]
        assert found.box.upper[column] < setting[column] <= found.box.upper[column] + 10 / 50
        others = [other for other in range(3) if other != column]
        assert (setting[others] <= found.box.upper[others]).all()


def test_a_limit_alone_ends_before_a_failure_that_the_search_for_limits_together_met() -> None:
    """A pocket between two values of the scan, in one of two fits, which no value of a limit alone
    hits.
    """

    def pocket(rows: FloatArray) -> BoolArray:
        return (rows[:, 0] > 7.01) & (rows[:, 0] < 7.04)

    own, other = made_up_model(2, nowhere), made_up_model(2, pocket, 1)
    alone = AloneSearch(scan(own.evaluator, [0, 1], Unsafe()), [0, 1], own)
    alone.add(own)
    alone.add(other)
    assert [each.safe for each in alone.limits()] == [(0.0, 10.0), (0.0, 10.0)]
    alone.meet([other], np.array([[7.02, 5.0]]))
    assert [each.safe for each in alone.limits()] == [
        (0.0, pytest.approx(7.01, abs=0.01)),
        (0.0, 10.0),
    ]
    assert alone.limits()[0].safe[1] <= 7.01
    assert pocket(alone.failures).all()


def test_a_tooth_between_corners_is_found_and_left_out() -> None:
    """No corner and no value alone is unsafe: from 6 to 6.5 of the first with the others below
    6.
    """

    def tooth(rows: FloatArray) -> BoolArray:
        return (np.abs(rows[:, 0] - 6.25) < 0.25) & (np.abs(rows[:, 1:] - 6.5) < 0.7).all(axis=1)

    found = box_of(3, tooth, {"a": Limit(at_least=3, at_most=7)})
    assert not tooth(found.box.at(default_rng(1).random((20_000, 3)))).any()
    assert relative_volume(found) > 0.02
    assert found.validations[0].attacked == (1 + CONFIRMATIONS) * 2000
    hit = falsify(
        Box(region_of(made_up_study(3)), np.zeros(3), np.full(3, 10.0)),
        [lambda rows: np.where(tooth(rows), -1.0, np.abs(rows - 6.3).max(axis=1))],
        [],
        2000,
        default_rng(0),
    )
    assert hit.robustness[0] == -1
    assert hit.simulated < 2000, "it ends soon after"


def test_the_box_holds_in_every_fit() -> None:
    """A second fit collides in one corner alone, between the corners of the first."""

    def second(rows: FloatArray) -> BoolArray:
        return (rows[:, 0] > 7) & (rows[:, 1] < 4) & (rows[:, 2] > 6)

    found = box_of(3, linear, {}, [second])
    assert [model.fit for model in found.members] == [0, 1]
    settings = np.concatenate(
        [found.box.corners(0, 0), found.box.at(default_rng(2).random((5000, 3)))]
    )
    assert not linear(settings).any()
    assert not second(settings).any()
    assert {*found.validations} == {0, 1}


def test_a_promise_that_a_fit_breaks_is_named_and_the_box_holds_in_the_others() -> None:
    found = box_of(
        2,
        nowhere,
        {"a": Limit(at_most=9)},
        [lambda rows: rows[:, 0] > 8, lambda rows: rows[:, 1] > 7],
    )
    assert [*found.broken] == [1]
    assert [model.fit for model in found.members] == [0, 2]
    assert found.box.upper.tolist() == [9, pytest.approx(7, abs=0.11)]


def test_limits_that_the_own_fit_breaks_have_no_box() -> None:
    found = box_of(2, lambda rows: rows[:, 0] > 7, {"a": Limit(at_most=9)})
    assert found.box is None
    assert found.broken.keys() == {0}
    assert found.specified.upper.tolist() == [9, 5]


def test_a_box_is_not_widened_through_what_fails_beside_it() -> None:
    def wall(rows: FloatArray) -> BoolArray:
        return (rows[:, 0] > 7) & (rows[:, 1] > 4)

    search = BoxSearch(made_up_model(2, wall), [0, 1], {}, np.zeros((0, 2)))
    search.corners.append(np.array([1.0, 1.0]))
    sides = search.widened(np.ones((2, 2)))
    assert not len(search.unsafe_inside(sides))
    assert sides[1, 0] == pytest.approx(2.0, abs=0.2), "up to the wall"
    assert sides[:, 1].tolist() == [5.0, 5.0]
