"""The largest box of vehicles without a case that is unsafe: proposed from what is known to fail,
searched for counterexamples, and proposed anew.

Nothing here knows of studies.
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
"""Standard deviations of the steps by which a random search changes a box, one after another, as
shares of the domain.
"""
PROPOSALS = 4096
"""Number of boxes that each of these rounds proposes."""
WHOLE = 0.05
"""Share of the sides that become as long as they may be instead: sides that no failure needs end a
little short in steps.
"""
LEAST_GAIN = 0.01
"""Least gain in the logarithm of the volume for which a box is simulated."""
LEAST_MOVE = 1 / 50
"""Unit of the distance by which limits keep off failures, as a share of the domain."""
MOST_CUTS = 100
"""Largest number of boxes of which something is cut off in turn."""
MOST_BRANCHES = 200
"""Number of boxes after which a branch and bound only follows the best cut."""
ROUNDING = 1e-9
"""Rounding errors of a value, as a share of the domain."""


class BoxEffort(NamedTuple):
    """How much a box is searched.

    Attributes
    ----------
    parts
        Into how many parts the way to something unsafe is divided, again and again.
    explored
        Boxes that a random search seeks before failures are only cut off.
    batch
        Cases that it simulates at once.
    growths
        How often a box that passed grows.
    learnt
        Failures of a box whose causes are sought.
    places
        Places of a box, at most, at which a failure is expected.
    retreat
        How much farther limits keep off failures after each box that failed, in `LEAST_MOVE`.
    farthest
        How far they keep off at most, as a share of the change that failed.
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
    """Boxes around an original vehicle, each given by its sides: how far it reaches below and above
    the original, shape (2, n).

    Attributes
    ----------
    space
        All cases: the domains of the vehicle's values, the worlds, and the places.
    longest
        The longest that each side may be; sides that are not free are just as long.
    printed
        Makes sides such as they are printed, no longer than before.
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
        """The widths of the domains; 0 where there is only one value."""
        space = self.space
        return (space.upper - space.lower)[: space.size]

    @property
    def fixed(self) -> FloatArray:
        """The sides of the smallest box: without those that are free."""
        return np.where(self.is_free, 0.0, self.longest)

    def ends(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The lowest and the highest values of a box."""
        return self.original - sides[0], self.original + sides[1]

    def cases_in(self, sides: FloatArray) -> Space:
        """The cases of a box."""
        return self.space.of_vehicles(*self.ends(sides))

    def log_volume(self, sides: FloatArray) -> FloatArray:
        """The logarithm of the volume of boxes, shape (..., 2, n), as a share of the domain's."""
        is_open = self.width > 0
        lengths = sides.sum(axis=-2)
        shares = np.ones_like(lengths)
        np.divide(lengths, self.width, out=shares, where=is_open)
        logarithms = np.log(np.maximum(shares, ROUNDING))
        return np.asarray(logarithms.sum(axis=-1))

    def extents(self, cases: FloatArray) -> FloatArray:
        """The sides that a box needs to hold each of K cases, shape (K, 2, n)."""
        changes = cases[:, : self.space.size] - self.original
        of_sides = np.stack([-changes, changes], axis=1)
        return np.maximum(of_sides - ROUNDING * self.width, 0.0)

    def shares(
        self,
        cases: FloatArray,
        sides: FloatArray,
    ) -> FloatArray:
        """Where cases lie in a box: their changes as shares of its sides."""
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
        """The cases at C places of B boxes, shape (B, C, n + 1 + k)."""
        n = self.space.size
        shares = places[:, :n]
        encounters = places[:, n:]
        ends = np.where(shares > 0, sides[:, 1:], sides[:, :1])
        shape = (len(sides), *encounters.shape)
        repeated = np.broadcast_to(encounters, shape)
        return np.concatenate([self.original + shares * ends, repeated], axis=2)


class Failures(NamedTuple):
    """What is known to fail: unsafe cases with as few changes as possible, the places of boxes
    where such cases were, and the number of these boxes.
    """

    cases: FloatArray
    places: FloatArray
    boxes: int = 0

    def at_places(
        self,
        boxes: Boxes,
        sides: FloatArray,
    ) -> FloatArray:
        """The cases at the places of a box where failures were."""
        (cases,) = boxes.cases_at(self.places, sides[np.newaxis])
        return np.asarray(cases)

    def inside(
        self,
        boxes: Boxes,
        sides: FloatArray,
    ) -> FloatArray:
        """The cases that a box holds."""
        is_inside = (boxes.extents(self.cases) <= sides).all(axis=(1, 2))
        return np.asarray(self.cases[is_inside])


class Attack(NamedTuple):
    """The number of cases that searched limits, and the least that these leave."""

    simulated: int = 0
    least: float = math.inf


class Settled(NamedTuple):
    """The sides of a box in which no search finds anything, None without one; what is known to
    fail then; and the searches.
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
    """The largest box in which a thorough search finds nothing; a quick one teaches where failures
    are.
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
    """The best box so far, or a larger one from its sides that passes, without what is known to
    fail then.
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
    """A box within another one in which no search finds anything."""
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
    """The largest sides within some sides that hold none of the known cases that a free side can
    cut off, by branch and bound. Limits keep off each failure by a `clearance`, in moves.

    Each failure is cut off by one side. The largest box that waits comes first, so that the first
    one without failures is the largest; after `MOST_BRANCHES` only the best cut is followed.
    """
    extents = boxes.extents(failures.cases)
    farthest = boxes.effort.farthest * extents
    distance = np.minimum(clearance * LEAST_MOVE * boxes.width, farthest)
    # A cut excludes its own failure also after rounding, so that this ends.
    ends = np.maximum(extents - distance - ROUNDING * boxes.width, 0.0)
    is_choice = boxes.is_free & (extents > 0)
    extents[~is_choice.any(axis=(1, 2))] = np.inf
    numbers = count()
    queue = [(0.0, next(numbers), sides)]
    for branch in count():
        sides = heappop(queue)[-1]
        is_inside = (extents <= sides).all(axis=(1, 2))
        if not is_inside.any():
            return sides

        # The failure whose best cut costs most is cut off first.
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
    """What is known with the unsafe cases of a box: as few of their changes as possible."""
    step = math.ceil(len(unsafe) / boxes.effort.learnt)
    causes = reduce_changes(boxes.judge, boxes.original, unsafe[::step])
    starts = causes.copy()
    starts[:, : boxes.space.size] = boxes.original
    parts = boxes.effort.parts
    lines = find_boundaries(starts, causes, lambda cases: boxes.judge(cases) < 0, parts)

    # A place for each combination of changes in each world: that of the worst case.
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
    """Unsafe cases with as few changes as possible, undone in turn."""
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
    """A box whose free sides are the largest share of those of another one with which it is safe
    at known places.
    """

    def at_share(shares: FloatArray) -> FloatArray:
        return np.where(boxes.is_free, shares[..., np.newaxis] * sides, boxes.longest)

    def are_unsafe(shares: FloatArray) -> BoolArray:
        candidates = at_share(shares)
        is_empty = np.array([*_are_empty(boxes, failures, candidates)])
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
    """A box that is safe at known places, as large as a random search makes it."""
    number = max(boxes.effort.batch // max(len(failures.places), 1), 1)
    for deviation in DEVIATIONS:
        proposals = _propose(boxes, sides, deviation, rng)
        is_empty = _are_empty(boxes, failures, proposals)
        chosen = [*islice(compress(proposals, is_empty), number)]
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
    """Boxes of which a random share of the sides is moved by random steps, larger than a box."""
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
    """Which of B boxes are safe at known places, shape (B,)."""
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
    extents = boxes.extents(failures.cases)
    hull = candidates.max(axis=0, initial=0.0)
    extents = extents[(extents <= hull).all(axis=(1, 2))]
    for sides in candidates:
        is_inside = (extents <= sides).all(axis=(1, 2))
        yield not is_inside.any()
