"""Cases, limits alone and the largest box against unsafe regions that are known in closed form."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.questions.boundary import (
    MOST_SEARCHES,
    Alone,
    scan_alone,
    search_alone,
)
from safevar_sumo.questions.cases import (
    PARENTS,
    CaseJudge,
    CaseSearch,
    Counterexamples,
    SearchPlan,
    Space,
    search_cases,
)
from safevar_sumo.questions.tolerance.boxes import (
    Boxes,
    Failures,
    cut,
    find_largest_box,
    learn,
    reduce_changes,
    settle,
    shrink,
    widen,
)
from safevar_sumo.records import FloatArray

PARTS = 8, 8, 8
Sides = FloatArray


def space_of(n: int, *, worlds: int = 1, center: FloatArray | None = None) -> Space:
    """n values from 0 to 10, some worlds, a phase and another place."""
    first = np.r_[np.zeros(n), 0, 0, 0]
    last = np.r_[np.full(n, 10.0), np.nextafter(worlds, 0), 1, 1]
    return Space(first, last, n, center)


def star_of(n: int) -> Space:
    return space_of(n, center=np.full(n, 5.0))


def boxes_of(
    n: int, judge: CaseJudge, given: dict[tuple[int, int], float] | None = None
) -> Boxes:
    """Boxes around 5 of which some sides are given."""
    longest = np.full((2, n), 5.0)
    is_free = np.ones((2, n), dtype=bool)
    for side, length in (given or {}).items():
        longest[side] = length
        is_free[side] = False
    return Boxes(
        judge, space_of(n), np.full(n, 5.0), longest, is_free, lambda sides: sides
    )


def nothing(n: int) -> FloatArray:
    return np.zeros((0, n + 3))


def cases_of(*vehicles: list[float]) -> FloatArray:
    return np.array([[*vehicle, 0.0, 0.0, 0.0] for vehicle in vehicles])


def search_of(judge: CaseJudge, budget: int, seed: int = 0) -> CaseSearch:
    rng = default_rng(seed)
    return lambda space, known: search_cases(
        judge, space, known, SearchPlan(budget), rng
    )


def unsafe_where(region: CaseJudge) -> CaseJudge:
    """A judge that knows no distance."""
    return lambda cases: np.where(region(cases), -1.0, 1.0)


LINEAR = np.array([1.0, 2.0, 3.0])
"""Weights of a region whose largest box has sides at 10, 7.5 and 5."""


def linear(cases: FloatArray) -> FloatArray:
    return np.asarray(10 - (cases[:, :3] - 5) @ LINEAR)


def tooth(cases: FloatArray) -> FloatArray:
    """No corner and no value alone is unsafe: the first from 6 to 6.5, the others about 6.5."""
    is_first = np.abs(cases[:, 0] - 6.25) < 0.25
    is_unsafe = is_first & (np.abs(cases[:, 1:3] - 6.5) < 0.7).all(axis=1)
    return np.where(is_unsafe, -1.0, np.abs(cases[:, :3] - 6.3).max(axis=1))


def moving(cases: FloatArray) -> FloatArray:
    """Where the encounter decides; the worst leaves 2 less."""
    return np.asarray(
        9 - (cases[:, :4] - 5).sum(axis=1) - 2 * np.sin(12 * cases[:, 6] + cases[:, 0])
    )


def share_of(boxes: Boxes, sides: Sides) -> float:
    return float(np.exp(boxes.log_volume(sides)))


def unsafe_in(boxes: Boxes, sides: Sides, judge: CaseJudge) -> int:
    """The unsafe of 20,000 cases of a box, by another draw than that of the search."""
    points = default_rng(9).random((20_000, len(boxes.space.lower)))
    n = boxes.space.size
    points[:, :n] = np.where(
        points[:, :n] < 0.25, 0, np.where(points[:, :n] > 0.75, 1, points[:, :n])
    )
    space = boxes.cases_in(sides)
    return int((judge(space.lower + points * (space.upper - space.lower)) < 0).sum())


def largest(boxes: Boxes) -> Sides:
    n = boxes.space.size
    start = Failures(nothing(n), nothing(n))
    quick, thorough = search_of(boxes.judge, 1024, 0), search_of(boxes.judge, 5000, 1)
    settled = find_largest_box(boxes, start, quick, thorough, default_rng(0))
    assert settled.sides is not None
    assert settled.attack.simulated >= 5000
    assert settled.attack.least >= 0
    return settled.sides


@pytest.mark.parametrize(
    ("judge", "n", "optimum", "share"),
    [
        (linear, 3, 0.375, 0.97),
        (moving, 4, ((5 + 7 / 4) / 10) ** 4, 0.95),
        (tooth, 3, 0.58, 1.0),
        (unsafe_where(lambda cases: (cases[:, :3] > 7).all(axis=1)), 3, 0.7, 0.97),
    ],
)
def test_the_box_is_nearly_the_largest_and_holds_nothing_unsafe(
    judge: CaseJudge, n: int, optimum: float, share: float
) -> None:
    boxes = boxes_of(n, judge)
    sides = largest(boxes)
    assert share * optimum < share_of(boxes, sides) <= 1.05 * optimum
    assert not unsafe_in(boxes, sides, judge)


def test_the_box_with_a_given_limit_is_nearly_the_largest() -> None:
    boxes = boxes_of(3, linear, {(1, 2): 2.0})
    sides = largest(boxes)
    assert sides[1, 2] == 2
    assert 0.97 * 0.315 < share_of(boxes, sides) <= 0.315


def test_no_box_where_what_is_given_fails() -> None:
    boxes = boxes_of(2, unsafe_where(lambda cases: cases[:, 0] > 7), {(1, 0): 4.0})
    settled = settle(
        boxes,
        Failures(nothing(2), nothing(2)),
        boxes.longest,
        [search_of(boxes.judge, 2000)],
    )
    assert settled.sides is None
    assert settled.failures.boxes == 1, "nothing can cut this off"


def test_a_search_finds_the_encounter_in_which_a_value_alone_is_unsafe() -> None:
    """Where the place is from 0.4 to 0.5, above 7; a scan at place 0 shows nothing."""

    def judge(cases: FloatArray) -> FloatArray:
        is_there = np.abs(cases[:, 4] - 0.45) < 0.05
        return np.where(is_there & (cases[:, 0] > 7), -1.0, 10 - cases[:, 0])

    star = star_of(2)
    start = Alone(star.lower[:2], star.upper[:2])
    scanned = scan_alone(judge, star, start, np.zeros((1, 3)), 100, PARTS)
    assert scanned.upper.tolist() == [10, 10]
    limits = search_alone(judge, star, scanned, search_of(judge, 2000), PARTS)
    assert limits.upper.tolist() == [pytest.approx(7, abs=0.02), 10]
    assert limits.upper[0] <= 7


def test_a_value_whose_limit_never_settles_stays_as_in_the_original() -> None:
    star = star_of(2)
    spaces = list[Space]()

    def search(space: Space, known: FloatArray) -> Counterexamples:
        spaces.append(space)
        cases = cases_of([space.upper[0], 5.0], [5.0, space.lower[1]])
        return Counterexamples(cases, np.array([-1.0, -1.0]))

    start = Alone(star.lower[:2], star.upper[:2])
    limits = search_alone(lambda cases: np.ones(len(cases)), star, start, search, (2,))
    assert limits.upper.tolist() == [5, 10]
    assert limits.lower.tolist() == [0, 5]
    assert len(spaces) == MOST_SEARCHES


def test_a_star_changes_one_value_and_a_space_holds_its_cases() -> None:
    star = star_of(4)
    cases = star.draw(1000, default_rng(0))
    assert set(np.count_nonzero(cases[:, :4] != 5, axis=1).tolist()) == {1}
    assert (np.count_nonzero(cases[:, :4] != 5, axis=0) > 150).all()
    children = star.children(cases[:PARENTS], 1000, default_rng(1))
    assert (np.count_nonzero(children[:, :4] != 5, axis=1) <= 1).all()
    space = space_of(4, worlds=3)
    drawn = space.draw(3000, default_rng(2))
    for each in (drawn, space.children(drawn[:PARENTS], 3000, default_rng(3))):
        assert ((each >= space.lower) & (each <= space.upper)).all()
        assert {*np.floor(each[:, 4])} == {0, 1, 2}, "the worlds"
    at_ends = (drawn == space.lower) | (drawn == space.upper)
    assert at_ends[:, :4].mean() == pytest.approx(0.5, abs=0.02)
    assert not at_ends[:, 4:].any()


def test_a_search_ends_soon_after_a_failure_or_with_its_budget() -> None:
    space = space_of(3)
    rng = default_rng(0)
    met = search_cases(tooth, space, nothing(3), SearchPlan(5000), rng)
    assert met.least == -1
    assert met.simulated < 5000
    assert (tooth(met.unsafe) < 0).all()
    met = search_cases(
        lambda cases: 1 + cases[:, 0],
        space,
        cases_of([0.25, 5, 5]),
        SearchPlan(1000),
        rng,
    )
    assert met.simulated == 1000
    assert met.least == 1
    assert not len(met.unsafe)
    known = cases_of([6.25, 6.5, 6.5])
    assert search_cases(tooth, space, known, SearchPlan(1), rng).least == -1, (
        "known ones come first"
    )


def test_children_lie_between_beside_and_around_their_parents() -> None:
    """Moved ones at nine places of parents at 4 and 5; others change about one value of seven."""
    rng = default_rng(0)
    parents = np.repeat(cases_of([4.0] * 4, [5.0] * 4), 16, axis=0)
    children = space_of(4).children(parents, 4000, rng)
    between = {
        pulled + shift for pulled in (4.0, 4.5, 5.0) for shift in (-0.7, 0.0, 0.7)
    }
    assert {*np.round(children[1::2, 0], 9).tolist()} == {
        round(value, 9) for value in between
    }
    values = children[::2, :4]
    assert 1 - np.isin(values, (4.0, 5.0)).mean() == pytest.approx(1.2 / 7, abs=0.01)
    assert np.isin(values, (0.0, 10.0)).mean() == pytest.approx(0.6 / 7, abs=0.01)


def test_no_box_without_failures_is_larger_than_the_cut() -> None:
    """Of all that move one limit in for each failure."""
    failures = default_rng(1).uniform(0, 10, (7, 2))
    boxes = boxes_of(2, linear)
    known = Failures(cases_of(*failures.tolist()), nothing(2))
    box = cut(boxes, boxes.longest, known, 0.0)
    assert not len(known.inside(boxes, box))
    volumes = []
    for columns in product((0, 1), repeat=7):
        sides = boxes.longest.copy()
        for failure, column in zip(boxes.extents(known.cases), columns, strict=True):
            side = np.argmax(failure[:, column])
            sides[side, column] = min(sides[side, column], failure[side, column])
        volumes.append(boxes.log_volume(sides))
    assert boxes.log_volume(box) == pytest.approx(max(volumes), abs=1e-6)


def test_a_cut_keeps_off_failures_by_its_clearance_and_cuts_no_given_side() -> None:
    known = Failures(cases_of([9.0, 9.5], [9.5, 8.0]), nothing(2))
    boxes = boxes_of(2, linear)
    near, far = (cut(boxes, boxes.longest, known, moves) for moves in (0.5, 5.0))
    assert near[1].tolist() == [pytest.approx(3.9), 5.0], "one limit cuts both off"
    assert far[1].tolist() == [pytest.approx(3.0), 5.0]
    given = boxes_of(2, linear, {(1, 0): 5.0})
    assert cut(given, given.longest, known, 0.5)[1].tolist() == [
        5.0,
        pytest.approx(2.9),
    ]


def test_causes_are_as_few_changes_as_possible_and_places_where_the_box_was_unsafe() -> (
    None
):
    judge = unsafe_where(lambda cases: (cases[:, 0] > 7) & (cases[:, 1] < 3))
    boxes = boxes_of(3, judge)
    unsafe = cases_of([9, 1, 8], [8, 2, 5])
    causes = reduce_changes(judge, boxes.original, unsafe)
    assert causes[:, :3].tolist() == [[9, 1, 5], [8, 2, 5]]
    known = learn(boxes, Failures(nothing(3), nothing(3)), unsafe, boxes.longest)
    assert known.boxes == 1
    assert (judge(known.cases) < 0).all()
    assert known.cases[:, 0].min() == pytest.approx(7, abs=0.02), (
        "nearly the first on its way"
    )
    assert known.places[:, :3].tolist() == [[0.8, -0.8, 0]]
    assert known.at_places(boxes, np.full((2, 3), 2.5))[:, :3].tolist() == [[7, 3, 5]]


def test_a_box_grows_up_to_a_wall_and_shrinks_from_what_is_beyond() -> None:
    judge = unsafe_where(lambda cases: (cases[:, 0] > 7) & (cases[:, 1] > 4))
    boxes = boxes_of(2, judge)
    known = Failures(nothing(2), cases_of([1.0, 0.0]))
    inner = shrink(boxes, known, boxes.longest)
    assert inner[1, 0] == pytest.approx(2, abs=0.02)
    sides = widen(boxes, known, inner, default_rng(0))
    assert sides[1, 0] == pytest.approx(2, abs=0.1)
    assert sides[1, 0] <= 2
    assert sides[:, 1].tolist() == [5, 5]
    assert (
        shrink(boxes, Failures(nothing(2), nothing(2)), inner).tolist()
        == inner.tolist()
    )


def test_a_scan_meets_each_value_in_each_encounter_and_a_limit_ends_in_the_worst() -> (
    None
):
    """Unsafe: above 6 at place 0, above 8 at place 1, and the second value below 1 at place 1."""
    cases = list[FloatArray]()

    def judge(rows: FloatArray) -> FloatArray:
        cases.append(rows)
        is_above = rows[:, 0] > 6 + 2 * rows[:, 4]
        return np.where(is_above | (rows[:, 1] < rows[:, 4]), -1.0, 1.0)

    star = star_of(2)
    start = Alone(np.array([0.0, 0.0]), np.array([10.0, 5.0]))
    encounters = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    limits = scan_alone(judge, star, start, encounters, 10, (2, 2))
    assert limits.lower.tolist() == [0, 1]
    assert limits.upper.tolist() == [6, 5]
    scanned = np.concatenate(cases[:2])
    assert len(scanned) == 3 * 2 * 10, "three sides may move"
    assert {*np.diff(np.unique(scanned[:, 0]))} == {0.5}
    assert [len(rows) for rows in cases[2:]] == [3, 3]
    failure = limits.breaches[1, 0]
    assert failure.tolist() == [6.125, 5, 0, 0, 0]
    assert limits.breaches[0, 1].tolist() == [5, 0.875, 0, 0, 1]


def test_what_a_search_keeps_is_the_worst_that_counts() -> None:
    start = Counterexamples(nothing(1), np.zeros(0))
    values = np.r_[np.inf, np.arange(40.0)[::-1]]
    cases = cases_of(*([value] for value in values.tolist()))
    met = start.after(cases, values)
    assert met.robustness.tolist() == [*range(PARENTS)]
    assert (met.simulated, met.least, len(met.unsafe)) == (41, 0, 0)
    every = met.after(cases, values - 39.5)
    assert len(every.cases) == len(every.unsafe) == 40, "all unsafe ones"
    assert every.least == -39.5


def test_a_box_settles_a_step_further_inwards_after_each_failure() -> None:
    """Failures above 7: the first box meets them, the second keeps off by 0.4 of 2 %."""
    boxes = boxes_of(1, unsafe_where(lambda cases: cases[:, 0] > 7))
    spaces = list[Space]()

    def search(space: Space, places: FloatArray) -> Counterexamples:
        spaces.append(space)
        met = Counterexamples(nothing(1), np.zeros(0))
        at_end = cases_of([space.upper[0]])
        return met.after(at_end, boxes.judge(at_end))

    def other(space: Space, places: FloatArray) -> Counterexamples:
        assert len(places) == 1
        return Counterexamples(places, np.array([0.25]), 20)

    known = Failures(nothing(1), nothing(1))
    settled = settle(boxes, known, boxes.longest, [search, other])
    assert settled.sides is not None
    assert settled.sides[:, 0].tolist() == [5, pytest.approx(2 - 0.08, abs=0.01)]
    assert settled.attack == (21, 0.25)
    assert [space.upper[0] for space in spaces] == [10, 5 + settled.sides[1, 0]]
    assert settled.failures.boxes == 1
    assert settled.failures.places[:, 0].tolist() == [1]
