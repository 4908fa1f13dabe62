"""How far each limit of a box can move out alone, and how it moves in where an attack found a
failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush
from itertools import count

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import falsify
from safevar_sumo.questions.models import judges_of
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.search import LEAST_GAIN, SEARCH_STAGE, BoxSearch
from safevar_sumo.questions.tolerance.sides import Step
from safevar_sumo.records import FloatArray

LEAST_MOVE = 1 / 50
"""A limit that cannot move out by this share of its range, or by one printed digit, is at its end.
"""
STRIDES = (1, 2, 4, 8)
"""Numbers of such moves that are tried at once, until one is too far."""
MAX_DIVES = 300
"""Number of boxes without failures that a branch and bound compares at most."""
SLAB_SIMULATIONS = 512
"""Number of simulations that falsify the room beyond a limit."""
SLAB_CORNERS = 512
"""Number of corners of that room, where encounters are ranges: the test of the box meets
many more.
"""
KNOWN_CORNERS = 32
"""Number of corners with which that attack begins."""


class Extension:
    """Moves limits as far as they can go, one at a time, and in where something failed."""

    def __init__(self, search: BoxSearch) -> None:
        self.search = search

    def of(self, box: Box) -> Box:
        """A box of which no limit can move out alone without meeting something unsafe."""
        steps: list[Step] = [*np.argwhere(self.search.is_free).tolist()]
        while steps:
            moved = list[Step]()
            for step in steps:
                wider = self._moved(box, step)
                if wider is not None:
                    box = wider
                    moved.append(step)
            steps = moved
        return box

    def _moved(self, box: Box, step: Step) -> Box | None:
        """The box with one limit moved out as far as nothing unsafe is met; None if it cannot
        move.
        """
        moved = None
        for stride in STRIDES:
            wider = self.moved(box, step, stride)
            if wider is None or self._is_blocked(box, wider, step):
                break
            moved = wider
        return moved

    def moved(self, box: Box, step: Step, stride: int = 1) -> Box | None:
        """The box with one limit moved out by some moves, rounded; None at the end of the
        domain.
        """
        side, column = step
        item = self.search.characteristics.members[column]
        end = box.end(side, column)
        last = (item.lower, item.upper)[side]
        if end == last:
            return None
        move = max(LEAST_MOVE * (item.upper - item.lower), 10.0**-item.digits)
        place = item.rounded(end + (-1, 1)[side] * stride * move, upwards=side == 0)
        place = max(place, last) if side == 0 else min(place, last)
        return box.with_end(side, column, place)

    def _is_blocked(self, box: Box, wider: Box, step: Step) -> bool:
        search = self.search
        side, column = step
        sides = search.sides_of(wider)
        if sides[side, column] > search.longest[side, column] or len(search.unsafe_inside(sides)):
            return True
        slab = wider.with_end(1 - side, column, wider.end(side, column)).corners(search.seed, 1)
        slab = np.random.default_rng(search.seed).permutation(slab)[:SLAB_CORNERS]
        settings = np.concatenate([slab, search.settings_at_end(sides, step)])
        if search.have_unsafe(settings[np.newaxis])[0]:
            return True
        judges = judges_of(search.first_models, SEARCH_STAGE)
        rng = Stream.EXTENSION.generator(search.seed, side, column)
        room = wider.with_end(1 - side, column, box.end(side, column))
        found = falsify(room, judges, [slab[:KNOWN_CORNERS]], SLAB_SIMULATIONS, rng).failures
        search.know(*found.values())
        return bool(found)

    def cut(self, box: Box, clearance: float, avoided: Sequence[FloatArray] = ()) -> Box:
        """The largest box within a box without its known failures. Limits keep off failures by a
        `clearance` above 0, as a share of a move. No box holds settings that are `avoided`, either,
        each of shape (K, n).
        """
        search = self.search
        sides = search.sides_of(box)
        failures = search.extents(np.concatenate([search.unsafe_inside(sides), *avoided]))
        failures = failures[(failures <= sides).all(axis=(1, 2))]
        if not len(failures):
            return box
        if not (search.is_free & (failures > 0)).any(axis=(1, 2)).all():
            return search.printed(search.fixed)
        return search.printed(self._without(sides, failures, clearance))

    def _without(self, sides: FloatArray, failures: FloatArray, clearance: float) -> FloatArray:
        """The largest sides within some sides without failures, given by their extents, shape
        (K, 2, n): by branch and bound, exact unless it ends after `MAX_DIVES`. Each failure is cut
        off by one limit, by a `clearance` more than it needs to.
        """
        search = self.search
        ends = np.maximum(failures - clearance * LEAST_MOVE * search.width, 0.0)
        is_choice = search.is_free & (failures > 0)
        places = np.arange(sides.size).reshape(sides.shape)
        numbers = count()
        waiting = [(-np.inf, next(numbers), sides)]
        best, least = sides, np.inf
        for _ in range(MAX_DIVES):
            # What waits is no smaller than what is left of it without failures.
            if not waiting or waiting[0][0] >= least - LEAST_GAIN:
                break
            sides = heappop(waiting)[-1]
            while len(inside := np.flatnonzero((failures <= sides).all(axis=(1, 2)))):
                lengths = np.maximum(sides.sum(axis=0), 1e-300)
                kept = (lengths - sides + ends[inside]) / lengths
                kept = np.where(is_choice[inside], kept, -np.inf)
                # The failure that costs most is cut off first, by the limit that loses least; its
                # other limits wait.
                hardest = np.argmin(kept.max(axis=(1, 2)))
                failure = inside[hardest]
                order = np.argsort(-kept[hardest], axis=None, kind="stable")
                sides, *others = (
                    np.where(places == place, ends[failure], sides)
                    for place in order[: np.count_nonzero(is_choice[failure])]
                )
                for other in others:
                    heappush(waiting, (-float(search.log_volume(other)), next(numbers), other))
            if search.log_volume(sides) > -least:
                best, least = sides, -float(search.log_volume(sides))
        return best

    def beyond(self, box: Box) -> dict[tuple[int, int], FloatArray]:
        """For each limit that could move out further, a known failure that it then meets."""
        beyond = dict[tuple[int, int], FloatArray]()
        for side, column in np.argwhere(self.search.domain > 0).tolist():
            wider = self.moved(box, (side, column))
            if wider is not None:
                for setting in self.search.unsafe_inside(self.search.sides_of(wider))[:1]:
                    beyond[side, column] = setting
        return beyond
