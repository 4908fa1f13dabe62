"""Cases, limits alone and the largest box against unsafe regions that are known in closed form."""

from __future__ import annotations

from collections.abc import Callable
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
    Counterexamples,
    Search,
    SearchPlan,
    _Rows,
    draw,
    search_scope,
)
from safevar_sumo.questions.drives import (
    Drives,
    Judged,
    Scope,
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
from safevar_sumo.records import BoolArray, FloatArray
from tests.support.made_up_studies import (
    Robustness,
    are_unsafe_by,
    drives_of,
    judge_by,
    places,
    scope_of,
)

pytestmark = pytest.mark.usefixtures("made_up_studies")

PARTS = 8, 8, 8


def star_of(n: int) -> Scope:
    return scope_of(n, center=np.full(n, 5.0))


def boxes_of(
    n: int, robustness: Robustness, given: dict[tuple[int, int], float] | None = None
) -> Boxes:
    """Boxes around 5 of which some sides are given."""
    longest = np.full((2, n), 5.0)
    is_free = np.ones((2, n), dtype=bool)
    for side, length in (given or {}).items():
        longest[side] = length
        is_free[side] = False
    return Boxes(
        are_unsafe_by(robustness),
        scope_of(n),
        np.full(n, 5.0),
        longest,
        is_free,
        lambda sides: sides,
    )


def nothing(n: int) -> Failures:
    return Failures.known(scope_of(n).nothing)


def search_of(robustness: Robustness, budget: int, seed: int = 0) -> Search:
    rng = default_rng(seed)
    judge = judge_by(robustness)
    return lambda scope, known: search_scope(
        judge, scope, known, SearchPlan(budget), rng
    )


def unsafe_where(region: Callable[[Drives], BoolArray]) -> Robustness:
    """A robustness that knows no distance."""
    return lambda drives: np.where(region(drives), -1.0, 1.0)


LINEAR = np.array([1.0, 2.0, 3.0])
"""Weights of a region whose largest box has sides at 10, 7.5 and 5."""


def linear(drives: Drives) -> FloatArray:
    return np.asarray(10 - (drives.vehicle - 5) @ LINEAR)


def tooth(drives: Drives) -> FloatArray:
    """No corner and no value alone is unsafe: the first from 6 to 6.5, the others about 6.5."""
    vehicle = drives.vehicle
    is_first = np.abs(vehicle[:, 0] - 6.25) < 0.25
    is_unsafe = is_first & (np.abs(vehicle[:, 1:] - 6.5) < 0.7).all(axis=1)
    return np.where(is_unsafe, -1.0, np.abs(vehicle - 6.3).max(axis=1))


def moving(drives: Drives) -> FloatArray:
    """Where the encounter decides; the worst leaves 2 less."""
    vehicle = drives.vehicle
    place = drives.encounters.place[:, 0]
    wave = np.sin(12 * place + vehicle[:, 0])
    return np.asarray(9 - (vehicle - 5).sum(axis=1) - 2 * wave)


def unsafe_in(boxes: Boxes, sides: FloatArray) -> int:
    """The unsafe of 20,000 cases of a box, by another draw than that of the search."""
    scope = boxes.scope_of(sides)
    drives = draw(scope, 20_000, default_rng(9))
    return int(boxes.are_unsafe(drives).sum())


def largest(boxes: Boxes, robustness: Robustness) -> FloatArray:
    start = nothing(len(boxes.original))
    quick, thorough = search_of(robustness, 1024, 0), search_of(robustness, 5000, 1)
    settled = find_largest_box(boxes, start, quick, thorough, default_rng(0))
    assert settled.sides is not None
    assert settled.attack.simulated >= 5000
    assert settled.attack.least is not None
    assert settled.attack.least >= 0
    return settled.sides


@pytest.mark.parametrize(
    ("robustness", "n", "given", "optimum", "share"),
    [
        (linear, 3, {}, 0.375, 0.97),
        (linear, 3, {(1, 2): 2.0}, 0.315, 0.97),
        (moving, 4, {}, ((5 + 7 / 4) / 10) ** 4, 0.95),
        (tooth, 3, {}, 0.58, 1.0),
        (
            unsafe_where(lambda drives: (drives.vehicle > 7).all(axis=1)),
            3,
            {},
            0.7,
            0.97,
        ),
    ],
)
def test_the_box_is_nearly_the_largest_and_holds_nothing_unsafe(
    robustness: Robustness,
    n: int,
    given: dict[tuple[int, int], float],
    optimum: float,
    share: float,
) -> None:
    """Also where a limit is given."""
    boxes = boxes_of(n, robustness, given)
    sides = largest(boxes, robustness)
    volume = np.exp(boxes.log_volume(sides))
    assert share * optimum < volume <= 1.05 * optimum
    assert {side: sides[side] for side in given} == given
    assert not unsafe_in(boxes, sides)


def test_no_box_where_what_is_given_fails() -> None:
    robustness = unsafe_where(lambda drives: drives.vehicle[:, 0] > 7)
    boxes = boxes_of(2, robustness, {(1, 0): 4.0})
    settled = settle(
        boxes,
        nothing(2),
        boxes.longest,
        [search_of(robustness, 2000)],
    )
    assert settled.sides is None
    assert settled.failures.boxes == 1, "nothing can cut this off"


def test_a_search_finds_the_encounter_in_which_a_value_alone_is_unsafe() -> None:
    """Where the place is from 0.4 to 0.5, above 7; a scan at place 0 shows nothing."""

    def robustness(drives: Drives) -> FloatArray:
        is_there = np.abs(drives.encounters.place[:, 0] - 0.45) < 0.05
        value = drives.vehicle[:, 0]
        return np.where(is_there & (value > 7), -1.0, 10 - value)

    star = star_of(2)
    start = Alone(star.lower, star.upper)
    are_unsafe = are_unsafe_by(robustness)
    scanned = scan_alone(are_unsafe, star, start, places(0.0), 100, PARTS)
    assert scanned.upper.tolist() == [10, 10]
    search = search_of(robustness, 2000)
    limits = search_alone(are_unsafe, star, scanned, search, PARTS)
    assert limits.upper.tolist() == [pytest.approx(7, abs=0.02), 10]
    assert limits.upper[0] <= 7


def test_a_value_whose_limit_never_settles_stays_as_in_the_original() -> None:
    star = star_of(2)
    scopes = list[Scope]()

    def search(scope: Scope, known: Drives) -> Counterexamples:
        scopes.append(scope)
        drives = drives_of([scope.upper[0], 5.0], [5.0, scope.lower[1]])
        return Counterexamples(Judged.simulated(drives, np.array([-1.0, -1.0])))

    start = Alone(star.lower, star.upper)
    are_unsafe = are_unsafe_by(lambda drives: np.ones(len(drives)))
    limits = search_alone(are_unsafe, star, start, search, (2,))
    assert limits.upper.tolist() == [5, 10]
    assert limits.lower.tolist() == [0, 5]
    assert len(scopes) == MOST_SEARCHES


def test_a_star_changes_one_value_and_a_scope_holds_its_drives() -> None:
    rows = _Rows(star_of(4), default_rng(0))
    drawn = rows.draw(1000)
    assert set(np.count_nonzero(drawn[:, :4] != 5, axis=1).tolist()) == {1}
    assert (np.count_nonzero(drawn[:, :4] != 5, axis=0) > 150).all()
    children = rows.children(drawn[:PARENTS], 1000)
    assert (np.count_nonzero(children[:, :4] != 5, axis=1) <= 1).all()
    scope = scope_of(4, worlds=3)
    rows = _Rows(scope, default_rng(2))
    drawn = rows.draw(3000)
    for each in (drawn, rows.children(drawn[:PARENTS], 3000)):
        drives = rows.drives(each)
        assert scope.holds(drives).all()
        assert {*drives.encounters.world.tolist()} == {0, 1, 2}
    vehicle = rows.drives(drawn).vehicle
    assert np.isin(vehicle, [0, 10]).mean() == pytest.approx(0.5, abs=0.02)


def test_a_search_ends_soon_after_a_failure_or_with_its_budget() -> None:
    scope = scope_of(3)
    rng = default_rng(0)
    judge = judge_by(tooth)
    met = search_scope(judge, scope, scope.nothing, SearchPlan(5000), rng)
    assert met.least == -1
    assert met.simulated < 5000
    assert (tooth(met.unsafe) < 0).all()
    met = search_scope(
        judge_by(lambda drives: 1 + drives.vehicle[:, 0]),
        scope,
        drives_of([0.25, 5, 5]),
        SearchPlan(1000),
        rng,
    )
    assert met.simulated == 1000
    assert met.least == 1
    assert not len(met.unsafe)
    known = drives_of([6.25, 6.5, 6.5])
    assert search_scope(judge, scope, known, SearchPlan(1), rng).least == -1, (
        "known ones come first"
    )


def test_children_lie_between_beside_and_around_their_parents() -> None:
    """Moved ones at nine places of parents at 4 and 5; others change about one value of seven."""
    rows = _Rows(scope_of(4), default_rng(0))
    parents = np.repeat(rows.of(drives_of([4.0] * 4, [5.0] * 4)), 16, axis=0)
    children = rows.children(parents, 4000)
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
    known = Failures.known(drives_of(*failures.tolist()))
    box = cut(boxes, boxes.longest, known, 0.0)
    assert not len(known.inside(boxes, box))
    volumes = []
    for columns in product((0, 1), repeat=7):
        sides = boxes.longest.copy()
        for failure, column in zip(
            boxes.extents(known.drives.vehicle), columns, strict=True
        ):
            side = np.argmax(failure[:, column])
            sides[side, column] = min(sides[side, column], failure[side, column])
        volumes.append(boxes.log_volume(sides))
    assert boxes.log_volume(box) == pytest.approx(max(volumes), abs=1e-6)


def test_a_cut_keeps_off_failures_by_its_clearance_and_cuts_no_given_side() -> None:
    known = Failures.known(drives_of([9.0, 9.5], [9.5, 8.0]))
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
    robustness = unsafe_where(
        lambda drives: (drives.vehicle[:, 0] > 7) & (drives.vehicle[:, 1] < 3)
    )
    boxes = boxes_of(3, robustness)
    unsafe = drives_of([9, 1, 8], [8, 2, 5])
    causes = reduce_changes(boxes.are_unsafe, boxes.original, unsafe)
    assert causes.vehicle.tolist() == [[9, 1, 5], [8, 2, 5]]
    known = learn(boxes, nothing(3), unsafe, boxes.longest)
    assert known.boxes == 1
    assert boxes.are_unsafe(known.drives).all()
    assert known.drives.vehicle[:, 0].min() == pytest.approx(7, abs=0.02), (
        "nearly the first on its way"
    )
    assert known.positions.vehicle.tolist() == [[0.8, -0.8, 0]]
    assert known.in_box(boxes, np.full((2, 3), 2.5)).vehicle.tolist() == [[7, 3, 5]]


def test_a_box_grows_up_to_a_wall_and_shrinks_from_what_is_beyond() -> None:
    robustness = unsafe_where(
        lambda drives: (drives.vehicle[:, 0] > 7) & (drives.vehicle[:, 1] > 4)
    )
    boxes = boxes_of(2, robustness)
    known = nothing(2)._replace(positions=drives_of([1.0, 0.0]))
    inner = shrink(boxes, known, boxes.longest)
    assert inner[1, 0] == pytest.approx(2, abs=0.02)
    sides = widen(boxes, known, inner, default_rng(0))
    assert sides[1, 0] == pytest.approx(2, abs=0.1)
    assert sides[1, 0] <= 2
    assert sides[:, 1].tolist() == [5, 5]
    assert shrink(boxes, nothing(2), inner).tolist() == inner.tolist()


def test_a_scan_meets_each_value_in_each_encounter_and_a_limit_ends_in_the_worst() -> (
    None
):
    """Unsafe: above 6 at place 0, above 8 at place 1, and the second value below 1 at place 1."""
    judged = list[Drives]()

    def are_unsafe(drives: Drives) -> BoolArray:
        judged.append(drives)
        first, second = drives.vehicle.T
        place = drives.encounters.place[:, 0]
        return np.asarray((first > 6 + 2 * place) | (second < place))

    star = star_of(2)
    start = Alone(np.array([0.0, 0.0]), np.array([10.0, 5.0]))
    limits = scan_alone(are_unsafe, star, start, places(0.0, 1.0), 10, (2, 2))
    assert limits.lower.tolist() == [0, 1]
    assert limits.upper.tolist() == [6, 5]
    scanned = Drives.concatenate(judged[:2]).vehicle
    assert len(scanned) == 3 * 2 * 10, "three sides may move"
    assert {*np.diff(np.unique(scanned[:, 0]))} == {0.5}
    assert [len(drives) for drives in judged[2:]] == [3, 3]
    failure = limits.breaches[1, 0]
    assert failure.vehicle.tolist() == [[6.125, 5]]
    assert failure.encounters.place.tolist() == [[0]]
    assert limits.breaches[0, 1].vehicle.tolist() == [[5, 0.875]]
    assert limits.breaches[0, 1].encounters.place.tolist() == [[1]]


def test_what_a_search_keeps_is_the_worst_that_counts() -> None:
    start = Counterexamples.of_nothing(scope_of(1))
    values = np.r_[np.inf, np.arange(40.0)[::-1]]
    drives = drives_of(*([value] for value in values.tolist()))
    met = start.after(Judged.simulated(drives, values))
    assert met.judged.robustness.tolist() == [*range(PARENTS)]
    assert (met.simulated, met.least, len(met.unsafe)) == (41, 0, 0)
    every = met.after(Judged.simulated(drives, values - 39.5))
    assert len(every.drives) == len(every.unsafe) == 40, "all unsafe ones"
    assert every.least == -39.5


def test_a_box_settles_a_step_further_inwards_after_each_failure() -> None:
    """Failures above 7: the first box meets them, the second keeps off by 0.4 of 2 %."""
    robustness = unsafe_where(lambda drives: drives.vehicle[:, 0] > 7)
    boxes = boxes_of(1, robustness)
    scopes = list[Scope]()

    def search(scope: Scope, starts: Drives) -> Counterexamples:
        scopes.append(scope)
        at_end = drives_of([scope.upper[0]])
        return Counterexamples.of_nothing(scope).after(judge_by(robustness)(at_end))

    def other(scope: Scope, starts: Drives) -> Counterexamples:
        assert len(starts) == 1
        return Counterexamples(Judged.simulated(starts, np.array([0.25])), 20)

    known = nothing(1)
    settled = settle(boxes, known, boxes.longest, [search, other])
    assert settled.sides is not None
    assert settled.sides[:, 0].tolist() == [5, pytest.approx(2 - 0.08, abs=0.01)]
    assert settled.attack == (21, 1, 0.25, 0)
    assert [scope.upper[0] for scope in scopes] == [10, 5 + settled.sides[1, 0]]
    assert settled.failures.boxes == 1
    assert settled.failures.positions.vehicle[:, 0].tolist() == [1]
