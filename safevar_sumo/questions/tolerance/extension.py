"""How far each limit of a box can move out alone, and how it moves in where an attack found a
failure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import falsify
from safevar_sumo.questions.models import judges_of
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.search import SEARCH_STAGE, BoxSearch
from safevar_sumo.questions.tolerance.sides import Step
from safevar_sumo.records import FloatArray

LEAST_MOVE = 1 / 50
"""A limit that cannot move out by this share of its range, or by one printed digit, is at its end.
"""
STRIDES = (1, 2, 4, 8)
"""Numbers of such moves that are tried at once, until one is too far."""
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
        """A box within a box without its known failures, as large as it may be: the failure that
        costs most is cut off first, by the limit that loses least. Limits keep off failures by a
        `clearance` above 0, as a share of a move. No box holds settings that are `avoided`, either,
        each of shape (K, n).
        """
        search = self.search
        sides = search.sides_of(box)
        failures = search.extents(np.concatenate([search.unsafe_inside(sides), *avoided]))
        if not (failures <= sides).all(axis=(1, 2)).any():
            return box
        while len(failures := failures[(failures <= sides).all(axis=(1, 2))]):
            is_choice = search.is_free & (failures > 0)
            if not is_choice.any(axis=(1, 2)).all():
                return search.printed(search.fixed)
            # Where each limit would end, and which share of its length would stay.
            ends = np.maximum(failures - clearance * LEAST_MOVE * search.width, 0.0)
            lengths = np.maximum(sides.sum(axis=0), 1e-300)
            kept = np.where(is_choice, (lengths - sides + ends) / lengths, -np.inf)
            hardest = np.argmin(kept.max(axis=(1, 2)))
            place = np.unravel_index(np.argmax(kept[hardest]), sides.shape)
            sides[place] = ends[hardest][place]
        return search.printed(sides)

    def beyond(self, box: Box) -> dict[tuple[int, int], FloatArray]:
        """For each limit that could move out further, a known failure that it then meets."""
        beyond = dict[tuple[int, int], FloatArray]()
        for side, column in np.argwhere(self.search.domain > 0).tolist():
            wider = self.moved(box, (side, column))
            if wider is not None:
                for setting in self.search.unsafe_inside(self.search.sides_of(wider))[:1]:
                    beyond[side, column] = setting
        return beyond
