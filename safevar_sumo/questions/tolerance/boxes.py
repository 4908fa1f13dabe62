"""The search for the largest box of vehicles that holds no unsafe case. A box is proposed from the
known failures, and searched for counterexamples. Counterexamples become known failures, and the
next box is proposed.

This module knows nothing of studies. A case is a vehicle (n values), the number of a world, and k
places; see `safevar_sumo.questions.cases`. The sides of a box, shape (2, n), are the distances from
the original vehicle to the box's lower ends (row 0) and to its upper ends (row 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from heapq import heappop, heappush
from itertools import compress, count, islice
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.cases import CaseJudge, CaseSearch, Space
from safevar_sumo.records import BoolArray, FloatArray

DEVIATIONS = tuple(0.35 * 0.6**number for number in range(6))
"""Rounds of a random search for a larger box: in each round, the standard deviation of the steps by
which the sides change, as a share of the domain.
"""
PROPOSALS = 4096
"""Number of boxes that each round of the random search proposes."""
WHOLE = 0.05
"""Share of the sides that a proposal makes as long as they may be. Random steps alone would leave a
side a little too short, even if no failure bounds this side.
"""
LEAST_GAIN = 0.01
"""Least gain in the logarithm of the volume for which a box is simulated."""
LEAST_MOVE = 1 / 50
"""Unit of the distance of a limit from the failure beyond it, as a share of the domain."""
MOST_CUTS = 100
"""Largest number of boxes that are searched in turn, each cut from the box before."""
MOST_BRANCHES = 200
"""Number of boxes after which the branch and bound follows only the best cut of each box."""
ROUNDING = 1e-9
"""Largest rounding error of a value, as a share of the domain."""


class BoxEffort(NamedTuple):
    """How much is done to find a large box.

    Attributes
    ----------
    parts
        Parts into which each round divides the way to an unsafe case; see `find_boundaries`.
    explored
        Most boxes that a random search proposes. Later boxes are only cut from these.
    batch
        Number of cases that the random search simulates at once.
    growths
        How often the search tries to enlarge a box that passed.
    learnt
        Largest number of failures of a box from which unneeded changes are removed.
    places
        Largest number of places of former failures at which a new box is tested first.
    retreat
        Growth of the distance between limits and failures after each failed box, in `LEAST_MOVE`.
    farthest
        Largest such distance, as a share of the change that failed.
    """

    parts: Sequence[int] = (8, 8, 8)
    explored: int = 8
    batch: int = 1024
    growths: int = 2
    learnt: int = 48
    places: int = 128
    retreat: float = 0.4
    farthest: float = 1.0


class Boxes(NamedTuple):
    """Everything that all boxes around an original vehicle share. A box is given by its sides,
    shape (2, n): the distances from the original to its lower ends (row 0) and upper ends (row 1).

    Attributes
    ----------
    judge
        Returns the robustness of cases; below 0 a case is unsafe.
    space
        The space of all cases: the domains of the vehicle's values, all worlds, and all places.
    longest
        The greatest length of each side, shape (2, n). A side that is not free always has this
        length.
    is_free
        Which sides the search may shorten, shape (2, n).
    printed
        Rounds sides to the digits that answers print. The rounded sides are not longer.
    """

    judge: CaseJudge
    space: Space
    original: FloatArray
    longest: FloatArray
    is_free: BoolArray
    printed: Callable[[FloatArray], FloatArray]
    effort: BoxEffort = BoxEffort()

    @property
    def width(self) -> FloatArray:
        """The width of the domain of each value, shape (n,); 0 for a value that does not vary."""
        space = self.space
        return (space.upper - space.lower)[: space.size]

    @property
    def fixed(self) -> FloatArray:
        """The sides of the smallest box, shape (2, n): free sides are 0."""
        return np.where(self.is_free, 0.0, self.longest)

    def ends(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest values of the vehicles in a box, each of shape (n,)."""
        return self.original - sides[0], self.original + sides[1]

    def cases_in(self, sides: FloatArray) -> Space:
        """The space of all cases of a box: its vehicles in all worlds, at all places."""
        return self.space.of_vehicles(*self.ends(sides))

    def log_volume(self, sides: FloatArray) -> FloatArray:
        """The logarithm of the volume of boxes, shape (..., 2, n), relative to the domain's."""
        is_open = self.width > 0
        lengths = sides.sum(axis=-2)
        shares = np.ones_like(lengths)
        np.divide(lengths, self.width, out=shares, where=is_open)
        logarithms = np.log(np.maximum(shares, ROUNDING))
        return np.asarray(logarithms.sum(axis=-1))

    def extents(self, cases: FloatArray) -> FloatArray:
        """The least sides with which a box holds a case, for each of K cases, shape (K, 2, n)."""
        changes = cases[:, : self.space.size] - self.original
        of_sides = np.stack([-changes, changes], axis=1)
        return np.maximum(of_sides - ROUNDING * self.width, 0.0)

    def shares(
        self,
        cases: FloatArray,
        sides: FloatArray,
    ) -> FloatArray:
        """The positions of K cases in a box, shape (K, n + 1 + k). Each value of the vehicle
        becomes its change from the original, as a share of the box's side (below 0 for a lower
        value). World and places stay. `cases_at` is the inverse function.
        """
        n = self.space.size
        changes = cases[:, :n] - self.original
        side = np.where(changes > 0, sides[1], sides[0])
        shares = np.zeros_like(changes)
        np.divide(changes, side, out=shares, where=side > 0)
        return np.hstack([shares, cases[:, n:]])

    def cases_at(
        self,
        places: FloatArray,
        sides: FloatArray,
    ) -> FloatArray:
        """The cases at C positions, shape (C, n + 1 + k), in each of B boxes, shape (B, 2, n). The
        result has shape (B, C, n + 1 + k). `shares` is the inverse function.
        """
        n = self.space.size
        shares = places[:, :n]
        encounters = places[:, n:]
        ends = np.where(shares > 0, sides[:, 1:], sides[:, :1])
        shape = (len(sides), *encounters.shape)
        repeated = np.broadcast_to(encounters, shape)
        return np.concatenate([self.original + shares * ends, repeated], axis=2)


class Failures(NamedTuple):
    """The known failures.

    Attributes
    ----------
    cases
        Unsafe cases with as few changes of the vehicle as possible, shape (K, n + 1 + k).
    places
        Positions in boxes at which unsafe cases were, shape (C, n + 1 + k); see `Boxes.shares`. The
        next box is tested at the same positions.
    boxes
        Number of the boxes in which unsafe cases were.
    """

    cases: FloatArray
    places: FloatArray
    boxes: int = 0

    def at_places(
        self,
        boxes: Boxes,
        sides: FloatArray,
    ) -> FloatArray:
        """The cases of a box at the positions of former failures, shape (C, n + 1 + k)."""
        (cases,) = boxes.cases_at(self.places, sides[np.newaxis])
        return np.asarray(cases)

    def inside(
        self,
        boxes: Boxes,
        sides: FloatArray,
    ) -> FloatArray:
        """The known unsafe cases that a box holds."""
        is_inside = (boxes.extents(self.cases) <= sides).all(axis=(1, 2))
        return np.asarray(self.cases[is_inside])


class Attack(NamedTuple):
    """A search for counterexamples: the number of its cases, and their least robustness."""

    simulated: int = 0
    least: float = math.inf


class Settled(NamedTuple):
    """The result of a search for a box.

    Attributes
    ----------
    sides
        The sides of a box in which no search found an unsafe case; None if there is no such box.
    failures
        The known failures after the search.
    attack
        How the box was searched.
    """

    sides: FloatArray | None
    failures: Failures
    attack: Attack = Attack()


def find_largest_box(
    boxes: Boxes,
    failures: Failures,
    quick: CaseSearch,
    thorough: CaseSearch,
    rng: Generator,
) -> Settled:
    """The largest box in which a thorough search finds no unsafe case.

    A quick search finds the failures of the first boxes, so that the thorough search, which costs
    more, begins with a box that is nearly safe.
    """
    effort = boxes.effort
    sides = boxes.longest
    for _ in range(effort.explored):
        start = cut(boxes, sides, failures, effort.retreat)
        core = shrink(boxes, failures, start)
        sides = widen(boxes, failures, core, rng)
        places = failures.at_places(boxes, sides)
        unsafe = quick(boxes.cases_in(sides), places).unsafe
        if not len(unsafe):
            break
        failures = learn(boxes, failures, unsafe, sides)
    best = settle(boxes, failures, sides, [thorough])
    for _ in range(effort.growths):
        if best.sides is None:
            break
        best = _grow(
            boxes,
            best,
            best.sides,
            thorough,
            rng,
        )
    return best


def _grow(
    boxes: Boxes,
    best: Settled,
    sides: FloatArray,
    search: CaseSearch,
    rng: Generator,
) -> Settled:
    """A box that is larger than the best box so far, if one passes the search. Otherwise the best
    box so far, reduced so that it holds none of the failures that became known.
    """
    wider = widen(boxes, best.failures, sides, rng)
    grown = settle(boxes, best.failures, wider, [search])
    smaller = boxes.printed(cut(boxes, sides, grown.failures, 0.0))
    if grown.sides is not None:
        gain = boxes.log_volume(grown.sides) - boxes.log_volume(smaller)
        if gain > 0:
            return grown
    return best._replace(sides=smaller, failures=grown.failures)


def settle(
    boxes: Boxes,
    failures: Failures,
    sides: FloatArray,
    searches: Sequence[CaseSearch],
) -> Settled:
    """A box, cut from the box with the given sides, in which no search finds an unsafe case."""
    for number in range(MOST_CUTS):
        if len(failures.inside(boxes, boxes.fixed)):
            break
        clearance = boxes.effort.retreat * number
        sides = boxes.printed(cut(boxes, sides, failures, clearance))
        space = boxes.cases_in(sides)
        places = failures.at_places(boxes, sides)
        simulated = 0
        least = math.inf
        for search in searches:
            result = search(space, places)
            simulated += result.simulated
            least = min(least, result.least)
            if len(result.unsafe):
                failures = learn(boxes, failures, result.unsafe, sides)
                break
        else:
            return Settled(sides, failures, Attack(simulated, least))
    return Settled(None, failures)


def cut(
    boxes: Boxes,
    sides: FloatArray,
    failures: Failures,
    clearance: float,
) -> FloatArray:
    """The sides of the largest box, within the given sides, that holds no known failure. Failures
    that no free side can cut off are ignored.

    One side is enough to cut off a failure: the side ends before the failure, with a distance of
    `clearance` times `LEAST_MOVE`. The choice of the sides is a branch and bound. The queue returns
    the largest box first. So the first box without failures is the largest one. After
    `MOST_BRANCHES` boxes only the best cut of each box is followed.
    """
    extents = boxes.extents(failures.cases)
    farthest = boxes.effort.farthest * extents
    distance = np.minimum(clearance * LEAST_MOVE * boxes.width, farthest)
    # A side also ends before the failure by the rounding error. Otherwise the box might still hold
    # the failure, and the same cut would be repeated for ever.
    ends = np.maximum(extents - distance - ROUNDING * boxes.width, 0.0)
    is_choice = boxes.is_free & (extents > 0)
    # No box holds a failure with infinite extents: it is ignored.
    extents[~is_choice.any(axis=(1, 2))] = np.inf
    numbers = count()
    queue = [(0.0, next(numbers), sides)]
    for branch in count():
        sides = heappop(queue)[-1]
        is_inside = (extents <= sides).all(axis=(1, 2))
        if not is_inside.any():
            return sides

        # Cut off the failure whose best cut costs most volume.
        rows = np.flatnonzero(is_inside)
        lengths = np.maximum(sides.sum(axis=0), ROUNDING)
        shares = (lengths - sides + ends[rows]) / lengths
        shares = np.where(is_choice[rows], shares, 0.0)
        row = rows[np.argmin(shares.max(axis=(1, 2)))]
        if branch > MOST_BRANCHES:
            queue = []
        for side, column in np.argwhere(is_choice[row]):
            smaller = sides.copy()
            smaller[side, column] = ends[row, side, column]
            loss = -float(boxes.log_volume(smaller))
            heappush(queue, (loss, next(numbers), smaller))
    raise AssertionError("the first box without failures is the largest")


def learn(
    boxes: Boxes,
    failures: Failures,
    unsafe: FloatArray,
    sides: FloatArray,
) -> Failures:
    """The known failures with new unsafe cases of a box, reduced to few and small changes."""
    step = math.ceil(len(unsafe) / boxes.effort.learnt)
    causes = reduce_changes(boxes.judge, boxes.original, unsafe[::step])
    starts = causes.copy()
    starts[:, : boxes.space.size] = boxes.original
    parts = boxes.effort.parts
    lines = find_boundaries(starts, causes, lambda cases: boxes.judge(cases) < 0, parts)

    # Keep one position for each combination of directions of change and world. Cases come worst
    # first, so the first row of a combination is its worst case.
    n = boxes.space.size
    directions = np.sign(causes[:, :n] - boxes.original)
    kinds = np.column_stack([directions, np.floor(causes[:, n])])
    rows = np.sort(np.unique(kinds, axis=0, return_index=True)[1])
    places = np.concatenate([boxes.shares(causes[rows], sides), failures.places])
    cases = np.concatenate([lines.unsafe, failures.cases])
    return Failures(cases, places[: boxes.effort.places], failures.boxes + 1)


def reduce_changes(
    judge: CaseJudge,
    original: FloatArray,
    unsafe: FloatArray,
) -> FloatArray:
    """The unsafe cases. Each change is undone in turn, if the case stays unsafe without it."""
    causes = unsafe.copy()
    for column, value in enumerate(original):
        candidates = causes.copy()
        candidates[:, column] = value
        rows = np.flatnonzero(causes[:, column] != value)
        rows = rows[judge(candidates[rows]) < 0]
        causes[rows] = candidates[rows]
    return causes


def shrink(
    boxes: Boxes,
    failures: Failures,
    sides: FloatArray,
) -> FloatArray:
    """A box with the free sides of another box, all multiplied by the same share. The share is the
    largest one found with which the box holds no known failure, and is safe at the positions of
    former failures.
    """

    def at_share(shares: FloatArray) -> FloatArray:
        return np.where(boxes.is_free, shares[..., np.newaxis] * sides, boxes.longest)

    def are_unsafe(shares: FloatArray) -> BoolArray:
        candidates = at_share(shares)
        is_empty = np.array(list(_are_empty(boxes, failures, candidates)))
        return ~(is_empty & _are_safe(boxes, failures, candidates))

    full = np.ones((1, 1))
    if not are_unsafe(full)[0]:
        return sides
    parts = boxes.effort.parts
    lines = find_boundaries(np.zeros((1, 1)), full, are_unsafe, parts)
    return np.asarray(at_share(lines.safe)[0])


def widen(
    boxes: Boxes,
    failures: Failures,
    sides: FloatArray,
    rng: Generator,
) -> FloatArray:
    """A larger box, found by a random search, that holds no known failure and is safe at the
    positions of former failures.
    """
    number = max(boxes.effort.batch // max(len(failures.places), 1), 1)
    for deviation in DEVIATIONS:
        proposals = _propose(boxes, sides, deviation, rng)
        is_empty = _are_empty(boxes, failures, proposals)
        chosen = list(islice(compress(proposals, is_empty), number))
        candidates = np.array(chosen).reshape(-1, *sides.shape)
        safe = candidates[_are_safe(boxes, failures, candidates)]
        sides = max(safe, key=boxes.log_volume, default=sides)
    return sides


def _propose(
    boxes: Boxes,
    sides: FloatArray,
    deviation: float,
    rng: Generator,
) -> FloatArray:
    """Up to `PROPOSALS` boxes, shape (B, 2, n), that are larger than the box with the given sides.
    In each box, a random share of the sides moves by random steps.
    """
    shape = (PROPOSALS, *sides.shape)
    is_moved = rng.random(shape) < rng.random((PROPOSALS, 1, 1))
    steps = rng.normal(0.0, deviation, shape) * is_moved * boxes.width
    candidates = np.clip(sides + steps, 0.0, boxes.longest)
    is_fixed = (rng.random(shape) < WHOLE) | ~boxes.is_free
    candidates = np.where(is_fixed, boxes.longest, candidates)
    volume = boxes.log_volume(sides) + LEAST_GAIN
    return np.asarray(candidates[boxes.log_volume(candidates) > volume])


def _are_safe(
    boxes: Boxes,
    failures: Failures,
    candidates: FloatArray,
) -> BoolArray:
    """Which of B boxes are safe at the positions of former failures, shape (B,)."""
    cases = boxes.cases_at(failures.places, candidates)
    robustness = boxes.judge(cases.reshape(-1, cases.shape[2]))
    is_safe = robustness.reshape(cases.shape[:2]) >= 0
    return np.asarray(is_safe.all(axis=1))


def _are_empty(
    boxes: Boxes,
    failures: Failures,
    candidates: FloatArray,
) -> Iterator[bool]:
    """Whether each of B boxes holds no known failure."""
    # Only failures within the hull of all boxes can be in one of the boxes.
    extents = boxes.extents(failures.cases)
    hull = candidates.max(axis=0, initial=0.0)
    extents = extents[(extents <= hull).all(axis=(1, 2))]
    for sides in candidates:
        is_inside = (extents <= sides).all(axis=(1, 2))
        yield not is_inside.any()
