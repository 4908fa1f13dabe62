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
        width = self.space.width
        return np.where(np.isinf(width), 0.0, width)

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
        shares = np.divide(
            sides.sum(axis=-2),
            self.width,
            out=np.ones_like(sides[..., 0, :]),
            where=is_open,
        )
        return np.asarray(np.log(np.maximum(shares, ROUNDING)).sum(axis=-1))

    def extents(self, cases: FloatArray) -> FloatArray:
        """The sides that a box needs to hold each of K cases, shape (K, 2, n)."""
        changes = cases[:, : self.space.size] - self.original
        of_sides = np.stack([-changes, changes], axis=1)
        return np.maximum(of_sides - ROUNDING * self.width, 0.0)

    def shares(self, cases: FloatArray, sides: FloatArray) -> FloatArray:
        """Where cases lie in a box: their changes as shares of its sides."""
        n = self.space.size
        changes = cases[:, :n] - self.original
        side = np.where(changes > 0, sides[1], sides[0])
        shares = np.divide(changes, side, out=np.zeros_like(changes), where=side > 0)
        return np.hstack([shares, cases[:, n:]])

    def cases_at(self, places: FloatArray, sides: FloatArray) -> FloatArray:
        """The cases at C places of B boxes, shape (B, C, n + 1 + k)."""
        n = self.space.size
        shares = places[:, :n]
        ends = np.where(shares > 0, sides[:, 1:], sides[:, :1])
        rest = np.broadcast_to(places[:, n:], (len(sides), *places[:, n:].shape))
        return np.concatenate([self.original + shares * ends, rest], axis=2)


class Known(NamedTuple):
    """What is known to fail: unsafe cases with as few changes as possible, the places of boxes
    where such cases were, and the number of these boxes.
    """

    cases: FloatArray
    places: FloatArray
    boxes: int = 0

    def at_places(self, boxes: Boxes, sides: FloatArray) -> FloatArray:
        """The cases at the places of a box where failures were."""
        return np.asarray(boxes.cases_at(self.places, sides[np.newaxis])[0])

    def inside(self, boxes: Boxes, sides: FloatArray) -> FloatArray:
        """The cases that a box holds."""
        is_inside = (boxes.extents(self.cases) <= sides).all(axis=(1, 2))
        return np.asarray(self.cases[is_inside])


class Settled(NamedTuple):
    """The sides of a box in which no search finds anything, None without one; what is known then;
    how many cases the searches met, and the least that these leave.
    """

    sides: FloatArray | None
    known: Known
    attacked: int = 0
    least: float = math.inf


def find_largest_box(
    boxes: Boxes, known: Known, quick: CaseSearch, thorough: CaseSearch, rng: Generator
) -> Settled:
    """The largest box in which a thorough search finds nothing; a quick one teaches where failures
    are.
    """
    effort = boxes.effort
    sides = boxes.longest
    for _ in range(effort.explored):
        start = without(boxes, sides, known, effort.retreat)
        sides = widened(boxes, known, shrunk(boxes, known, start), rng)
        unsafe = quick(boxes.cases_in(sides), known.at_places(boxes, sides)).unsafe
        if not len(unsafe):
            break
        known = learn(boxes, known, unsafe, sides)
    best = settle(boxes, known, sides, [thorough])
    for _ in range(effort.growths):
        if best.sides is None:
            break
        best = _grown(boxes, best, thorough, rng)
    return best


def _grown(boxes: Boxes, best: Settled, search: CaseSearch, rng: Generator) -> Settled:
    """A box that passed, or a larger one from it that passes, without what is known then."""
    assert best.sides is not None
    wider = widened(boxes, best.known, best.sides, rng)
    grown = settle(boxes, best.known, wider, [search])
    cut = boxes.printed(without(boxes, best.sides, grown.known, 0.0))
    if grown.sides is None or boxes.log_volume(grown.sides) <= boxes.log_volume(cut):
        return best._replace(sides=cut, known=grown.known)
    return grown


def settle(
    boxes: Boxes, known: Known, sides: FloatArray, searches: Sequence[CaseSearch]
) -> Settled:
    """A box within another one in which no search finds anything."""
    for number in range(MOST_CUTS):
        if len(known.inside(boxes, boxes.fixed)):
            break
        sides = boxes.printed(
            without(boxes, sides, known, boxes.effort.retreat * number)
        )
        space, places = boxes.cases_in(sides), known.at_places(boxes, sides)
        attacked, least, unsafe = 0, math.inf, places[:0]
        for search in searches:
            met = search(space, places)
            attacked, least, unsafe = (
                attacked + met.simulated,
                min(least, met.least),
                met.unsafe,
            )
            if len(unsafe):
                break
        if not len(unsafe):
            return Settled(sides, known, attacked, least)
        known = learn(boxes, known, unsafe, sides)
    return Settled(None, known)


def without(
    boxes: Boxes, sides: FloatArray, known: Known, clearance: float
) -> FloatArray:
    """The largest sides within some sides that hold none of the known cases that a free side can
    cut off, by branch and bound. Limits keep off each failure by a `clearance`, in moves.

    Each failure is cut off by one side. The largest box that waits comes first, so that the first
    one without failures is the largest; after `MOST_BRANCHES` only the best cut is followed.
    """
    extents = boxes.extents(known.cases)
    distance = np.minimum(
        clearance * LEAST_MOVE * boxes.width, boxes.effort.farthest * extents
    )
    # A cut excludes its own failure also after rounding, so that this ends.
    ends = np.maximum(extents - distance - ROUNDING * boxes.width, 0.0)
    is_choice = boxes.is_free & (extents > 0)
    extents[~is_choice.any(axis=(1, 2))] = np.inf
    numbers = count()
    waiting = [(0.0, next(numbers), sides)]
    for branch in count():
        sides = heappop(waiting)[-1]
        inside = np.flatnonzero((extents <= sides).all(axis=(1, 2)))
        if not len(inside):
            return sides

        # The failure whose best cut costs most is cut off first.
        lengths = np.maximum(sides.sum(axis=0), ROUNDING)
        kept = (lengths - sides + ends[inside]) / lengths
        kept = np.where(is_choice[inside], kept, 0.0)
        hardest = inside[np.argmin(kept.max(axis=(1, 2)))]
        if branch > MOST_BRANCHES:
            waiting = []
        for side, column in np.argwhere(is_choice[hardest]):
            smaller = sides.copy()
            smaller[side, column] = ends[hardest, side, column]
            heappush(
                waiting, (-float(boxes.log_volume(smaller)), next(numbers), smaller)
            )
    raise AssertionError("the first box without failures is the largest")


def learn(boxes: Boxes, known: Known, unsafe: FloatArray, sides: FloatArray) -> Known:
    """What is known with the unsafe cases of a box: as few of their changes as possible."""
    spread = unsafe[:: math.ceil(len(unsafe) / boxes.effort.learnt)]
    causes = with_fewest_changes(boxes.judge, boxes.original, spread)
    starts = causes.copy()
    starts[:, : boxes.space.size] = boxes.original
    lines = find_boundaries(
        starts, causes, lambda cases: boxes.judge(cases) < 0, boxes.effort.parts
    )

    # A place for each combination of changes in each world: that of the worst case.
    n = boxes.space.size
    directions = np.sign(causes[:, :n] - boxes.original)
    kinds = np.column_stack([directions, np.floor(causes[:, n])])
    rows = np.sort(np.unique(kinds, axis=0, return_index=True)[1])
    places = np.concatenate([boxes.shares(causes[rows], sides), known.places])
    cases = np.concatenate([lines.unsafe, known.cases])
    return Known(cases, places[: boxes.effort.places], known.boxes + 1)


def with_fewest_changes(
    judge: CaseJudge, original: FloatArray, unsafe: FloatArray
) -> FloatArray:
    """Unsafe cases with as few changes as possible, undone one after another."""
    causes = unsafe.copy()
    for column, value in enumerate(original):
        undone = causes.copy()
        undone[:, column] = value
        rows = np.flatnonzero(causes[:, column] != value)
        rows = rows[judge(undone[rows]) < 0]
        causes[rows] = undone[rows]
    return causes


def shrunk(boxes: Boxes, known: Known, sides: FloatArray) -> FloatArray:
    """A box whose free sides are the largest share of those of another one with which it is safe
    at known places.
    """

    def at_share(shares: FloatArray) -> FloatArray:
        return np.where(boxes.is_free, shares[..., np.newaxis] * sides, boxes.longest)

    def are_unsafe(shares: FloatArray) -> BoolArray:
        tried = at_share(shares)
        holds_nothing = np.array([*_hold_nothing(boxes, known, tried)])
        return ~(holds_nothing & _are_safe(boxes, known, tried))

    whole = np.ones((1, 1))
    if not are_unsafe(whole)[0]:
        return sides
    lines = find_boundaries(np.zeros((1, 1)), whole, are_unsafe, boxes.effort.parts)
    return np.asarray(at_share(lines.safe)[0])


def widened(
    boxes: Boxes, known: Known, sides: FloatArray, rng: Generator
) -> FloatArray:
    """A box that is safe at known places, as large as a random search makes it."""
    number = max(boxes.effort.batch // max(len(known.places), 1), 1)
    for deviation in DEVIATIONS:
        tried = _proposals(boxes, sides, deviation, rng)
        chosen = islice(compress(tried, _hold_nothing(boxes, known, tried)), number)
        tried = np.array([*chosen]).reshape(-1, *sides.shape)
        safe = tried[_are_safe(boxes, known, tried)]
        sides = max(safe, key=boxes.log_volume, default=sides)
    return sides


def _proposals(
    boxes: Boxes, sides: FloatArray, deviation: float, rng: Generator
) -> FloatArray:
    """Boxes of which a random share of the sides is moved by random steps, larger than one box."""
    shape = (PROPOSALS, *sides.shape)
    is_moved = rng.random(shape) < rng.random((PROPOSALS, 1, 1))
    steps = rng.normal(0.0, deviation, shape) * is_moved * boxes.width
    moved = np.clip(sides + steps, 0.0, boxes.longest)
    moved = np.where(rng.random(shape) < WHOLE, boxes.longest, moved)
    tried = np.where(boxes.is_free, moved, boxes.longest)
    return np.asarray(
        tried[boxes.log_volume(tried) > boxes.log_volume(sides) + LEAST_GAIN]
    )


def _are_safe(boxes: Boxes, known: Known, tried: FloatArray) -> BoolArray:
    """Which of B boxes are safe at known places, shape (B,)."""
    cases = boxes.cases_at(known.places, tried)
    robustness = boxes.judge(cases.reshape(-1, cases.shape[2]))
    return np.asarray((robustness.reshape(cases.shape[:2]) >= 0).all(axis=1))


def _hold_nothing(boxes: Boxes, known: Known, tried: FloatArray) -> Iterator[bool]:
    """Whether each of B boxes holds no known failure."""
    extents = boxes.extents(known.cases)
    extents = extents[(extents <= tried.max(axis=0, initial=0.0)).all(axis=(1, 2))]
    return (not (extents <= sides).all(axis=(1, 2)).any() for sides in tried)
