"""The search for the largest box in which characteristics may vary together, with limits that the
user specifies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice

import numpy as np

from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.sides import BoxGeometry, Step
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Limit

SHRINKING = (8, 8, 8)
"""Number of parts into which each round divides the sizes between a safe and an unsafe box."""
WIDENING = 0.02
"""Share of its domain by which a side of the box is widened in search of something unsafe."""
SEARCH_POINTS = 256
"""Number of Sobol points, and of corners, at which a box is searched for something unsafe."""
SLAB_POINTS = 64
"""Number of Sobol points, and of corners, at which the room beside a box is searched."""
SEARCHED_MODELS = 4
"""Number of models in which a box is searched at once."""
MAX_ATTEMPTS = 40
"""Maximum number of boxes that are searched for something unsafe, and of tests."""
DEVIATIONS = tuple(0.35 * 0.7**k for k in range(9))
"""Standard deviations of the steps by which a random search changes a box, round by round, as
shares of the domain.
"""
PROPOSALS = 4096
"""Number of boxes that a round of the random search proposes."""
BATCH, LEAST_BATCH = 512, 64
"""Simulations, at all points of a study's matrix, that cost hardly more than one; fewest settings
of a batch.
"""
LEAST_GAIN = 0.01
"""Least gain in the logarithm of the volume for which a proposed box is simulated."""
UNDONE_AT_ONCE = 4
"""Number of changes of a setting of which all combinations are undone in one batch, in search of
its causes.
"""
SEARCH_STAGE = "search of the limits together"


class BoxSearch(BoxGeometry):
    """The search for a box that is safe in some models.

    Attributes
    ----------
    models
        Fits of the vehicle, at points of the study, in which a box has to be safe; more may `join`.
    unsafe_settings
        Settings that no box may hold.
    corners
        Corners that were unsafe in some box: for each characteristic -1, the lower end of the box,
        0, the original, or 1, the upper end; for each parameter of the scenario its place between
        original and end.
    batch
        Number of settings that are simulated at once.
    """

    def __init__(
        self,
        model: Model,
        columns: Sequence[int],
        limits: Mapping[str, Limit],
        unsafe_settings: FloatArray,
    ) -> None:
        super().__init__(model.evaluator.region, columns, limits)
        self.models = [model]
        self.unsafe_settings = unsafe_settings
        self.corners = list[FloatArray]()
        self.search_count = 0
        self.seed = model.evaluator.seed
        self._attempts = model.evaluator.scaled(MAX_ATTEMPTS)
        self._points = model.evaluator.scaled(SEARCH_POINTS)
        self.batch = max(BATCH // len(model.numbers_of_points), LEAST_BATCH)

    def join(self, model: Model) -> None:
        """Take a model into the search, or more points of one that is in it."""
        for number, member in enumerate(self.models):
            is_same = member.at_worst_phase == model.at_worst_phase
            if member.evaluator is model.evaluator and is_same:
                if member.points is None or model.points is None:
                    model = member._replace(points=None)
                else:
                    points = {*member.points, *model.points}
                    model = member._replace(points=tuple(sorted(points)))
                del self.models[number]
                break
        self.models.insert(0, model)

    def know(self, *settings: FloatArray) -> None:
        """Know unsafe settings, each of shape (K, n): no later box holds one of them."""
        self.unsafe_settings = np.concatenate([self.unsafe_settings, *settings])

    @property
    def first_models(self) -> list[Model]:
        """The models in which a box is searched: those in which something failed last. Its test
        meets them all.
        """
        return self.models[:SEARCHED_MODELS]

    @property
    def failures_alone(self) -> FloatArray:
        """The known unsafe settings in which one characteristic of the vehicle is changed, shape
        (K, n).
        """
        is_changed = (self.unsafe_settings != self.original) & self.characteristics.of_vehicle
        return np.asarray(self.unsafe_settings[np.count_nonzero(is_changed, axis=1) == 1])

    def unsafe_inside(self, sides: FloatArray) -> FloatArray:
        """The known unsafe settings that a box holds."""
        extents = self.extents(self.unsafe_settings)
        return np.asarray(self.unsafe_settings[(extents <= sides).all(axis=(1, 2))])

    def holds_failure(self, box: Box) -> bool:
        """Whether a box holds a known unsafe setting."""
        return len(self.unsafe_inside(self.sides_of(box))) > 0

    def are_unsafe(self, settings: FloatArray) -> BoolArray:
        """Simulate settings, shape (..., n), and remember the unsafe ones: no later box holds one
        of them.
        """
        rows = settings.reshape(-1, 1, len(self.original))
        return self.have_unsafe(rows).reshape(settings.shape[:-1])

    def have_unsafe(self, groups: FloatArray) -> BoolArray:
        """Which of G groups of settings, shape (G, K, n), hold an unsafe one; unsafe ones are
        remembered.

        A group is simulated in one model after another until one is unsafe; the model that last
        found some is the first.
        """
        has_unsafe = np.zeros(len(groups), dtype=bool)
        for model in self.first_models:
            waiting = np.flatnonzero(~has_unsafe)
            rows = groups[waiting].reshape(-1, len(self.original))
            if not len(rows):
                break
            is_unsafe = model.are_unsafe(rows, SEARCH_STAGE)
            if is_unsafe.any():
                self.models.remove(model)
                self.models.insert(0, model)
            self.know(rows[is_unsafe])
            has_unsafe[waiting] = is_unsafe.reshape(len(waiting), -1).any(axis=1)
        return has_unsafe

    def corner_settings(self, boxes: FloatArray) -> FloatArray:
        """Settings at the C known corners of B boxes, shape (B, C, n)."""
        corners = np.array(self.corners)
        return self.original + corners * np.where(
            corners > 0, boxes[:, 1:], boxes[:, :1]
        )  # a corner of 0 is the original

    def points(self, sides: FloatArray, number: int) -> FloatArray:
        """New Sobol points and corners of a box."""
        self.search_count += 1
        return self.box(sides).spread_and_corners(number, self.seed + self.search_count)

    def failures_in(self, sides: FloatArray) -> FloatArray:
        """Unsafe settings of a box: the known ones; without any, those that a new search finds."""
        known = self.unsafe_inside(sides)
        if len(known):
            return known
        points = self.points(sides, self._points)
        return points[self.are_unsafe(points)]

    def learn(self, settings: FloatArray, model: Model | None = None) -> FloatArray:
        """Add corners that are unsafe, from some settings that are unsafe in a model, or in any;
        their causes, shape (K, n).

        One by one, as many changes of a setting as possible are undone while it stays unsafe; the
        directions of the remaining changes are the corner. All combinations of the next few are
        simulated at once.
        """
        number = min(len(settings), self.batch // 2**UNDONE_AT_ONCE)
        causes = self._causes(settings[:: len(settings) // number][:number], model)
        known = {corner.tobytes(): corner for corner in [*self.corners, *self._corners_of(causes)]}
        self.corners = list(known.values())
        self._keep_causes(causes)
        return causes

    def approach(self, causes: FloatArray, model: Model) -> FloatArray:
        """Know, for each change of K causes, the value nearest to the original from which on it is
        unsafe with the others: the settings in which all changes have these values, shape (K, n).
        """
        rows, columns = np.nonzero((causes != self.original) & self.is_free.any(axis=0))
        ends = causes[rows]
        starts = ends.copy()
        starts[np.arange(len(rows)), columns] = self.original[columns]
        found = find_boundaries(starts, ends, partial(model.are_unsafe, stage=SEARCH_STAGE))
        self.know(found.unsafe)
        nearest = causes.copy()
        nearest[rows, columns] = found.unsafe[np.arange(len(rows)), columns]
        return nearest

    def _corners_of(self, causes: FloatArray) -> FloatArray:
        """The directions of the changes of K causes, shape (K, n); of a scenario's parameter its
        place.
        """
        changes = causes - self.original
        sides = np.where(changes > 0, self.domain[1], self.domain[0])
        shares = np.divide(changes, sides, out=np.zeros_like(changes), where=sides > 0)
        return np.where(self.characteristics.of_vehicle, np.sign(changes), shares)

    def _keep_causes(self, causes: FloatArray) -> None:
        """Know K causes, and forget settings with more than a cause's changes: a box that holds one
        holds the cause.
        """
        needs = np.maximum(self.extents(self.unsafe_settings), 0.0)
        for cause in np.maximum(self.extents(causes), 0.0):
            is_kept = ~(needs >= cause).all(axis=(1, 2))
            needs = needs[is_kept]
            self.unsafe_settings = self.unsafe_settings[is_kept]
        self.know(np.unique(causes, axis=0))

    def _causes(self, settings: FloatArray, model: Model | None) -> FloatArray:
        """Unsafe settings with as few changes as possible, from K that are unsafe in a model, or in
        any.
        """
        causes = settings.copy()
        columns = np.flatnonzero(self.is_free.any(axis=0))
        for start in range(0, len(columns), UNDONE_AT_ONCE):
            group = columns[start : start + UNDONE_AT_ONCE]
            bits = 1 << np.arange(len(group))
            is_undone = np.zeros((2 ** len(group), len(self.original)), dtype=bool)
            is_undone[:, group] = np.arange(2 ** len(group))[:, np.newaxis] & bits
            variants = np.where(is_undone, self.original, causes[:, np.newaxis])
            if model is None:
                are_unsafe = self.are_unsafe(variants)
            else:
                rows = variants.reshape(-1, len(self.original))
                are_unsafe = model.are_unsafe(rows, SEARCH_STAGE).reshape(variants.shape[:-1])
            for cause, of_cause, is_unsafe in zip(causes, variants, are_unsafe, strict=True):
                chosen = 0
                for bit in bits:
                    chosen += bit * is_unsafe[chosen + bit]
                cause[:] = of_cause[chosen]
        return causes

    def are_safe(self, boxes: FloatArray) -> BoolArray:
        """Which of B boxes, shape (B, 2, n), are safe at the known corners."""
        return ~self.have_unsafe(self.corner_settings(boxes))

    def shrunk(self, sides: FloatArray, start: FloatArray) -> FloatArray:
        """A box whose free sides are the largest share of `sides` with which it is safe."""
        whole = np.where(self.is_free, sides, start).reshape(1, -1)
        if not self._are_unsafe_boxes(whole)[0]:
            return whole.reshape(start.shape)
        least = np.where(self.is_free, 0.0, start).reshape(1, -1)
        found = find_boundaries(least, whole, self._are_unsafe_boxes, SHRINKING)
        return found.safe.reshape(start.shape)

    def _are_unsafe_boxes(self, rows: FloatArray) -> BoolArray:
        """Which of B boxes, a row of sides each, are unsafe at known corners, or hold a known
        failure.
        """
        boxes = rows.reshape(-1, *self.domain.shape)
        needs = self.extents(self.unsafe_settings)
        holds_failure = [(needs <= box).all(axis=(1, 2)).any() for box in boxes]
        return np.asarray(~self.are_safe(boxes) | holds_failure)

    def largest(self, sides: FloatArray, start: FloatArray) -> FloatArray:
        """A box within `start` that is safe at the known corners, and keeps off known unsafe
        settings, as large as a random search makes it.

        `sides` first shrink as a whole until they are safe. Larger boxes nearby are then simulated
        at their corners.
        """
        rng = Stream.LARGER_BOXES.generator(self.seed)
        best = self.shrunk(sides, start)
        for deviation in DEVIATIONS:
            larger = self._larger(best, start, deviation, rng)
            tried = [
                *islice(
                    self._without_known_failures(larger), max(self.batch // len(self.corners), 1)
                )
            ]
            if tried:
                boxes = np.array(tried)
                best = max(boxes[self.are_safe(boxes)], key=self.log_volume, default=best)
        return best

    def _larger(
        self, best: FloatArray, start: FloatArray, deviation: float, rng: np.random.Generator
    ) -> FloatArray:
        """Larger boxes near to the best one, within `start`, shape (B, 2, n): random steps of a
        random share of the sides.
        """
        shape = (PROPOSALS, *start.shape)
        is_moved = rng.random(shape) < rng.random((PROPOSALS, 1, 1))
        steps = rng.normal(0.0, deviation, shape) * is_moved
        boxes = np.where(self.is_free, np.clip(best + steps * self.width, 0.0, start), start)
        return np.asarray(boxes[self.log_volume(boxes) > self.log_volume(best) + LEAST_GAIN])

    def _without_known_failures(self, boxes: FloatArray) -> Iterator[FloatArray]:
        """Those of B boxes, shape (B, 2, n), that no known failure forbids."""
        needs = self.extents(self.unsafe_settings)
        needs = needs[(needs <= boxes.max(axis=0, initial=0.0)).all(axis=(1, 2))]
        columns = np.ascontiguousarray(
            needs.reshape(-1, self.domain.size).T
        )  # a side in a row: compared without copies
        for box in boxes:
            if not np.logical_and.reduce(columns <= box.reshape(-1, 1), axis=0).any():
                yield box

    def widened(self, sides: FloatArray) -> FloatArray:
        """Move the free sides of a box outwards in steps, until something unsafe is in the next
        step of each or the domain ends. Sides move together where their steps together are safe,
        too.
        """
        steps: list[Step] = [*np.argwhere(self.is_free & (sides < self.longest)).tolist()]
        while steps := self.safe_steps(sides, [[step] for step in steps]):
            sides = self.wider(sides, self.safe_steps(sides, [steps]) or steps[:1], WIDENING)
            steps = [step for step in steps if sides[*step] < self.longest[*step]]
        return sides

    def safe_steps(self, sides: FloatArray, groups: Sequence[Sequence[Step]]) -> list[Step]:
        """The steps outwards in which nothing unsafe is found; those of a group are made
        together.
        """

        def is_open(box: FloatArray, step: Step) -> bool:
            side, column = step
            known = self.unsafe_inside(box)
            return not (self.extents(known)[:, side, column] > sides[side, column]).any()

        boxes = [(self.wider(sides, group, WIDENING), group) for group in groups]
        steps = [(box, step) for box, group in boxes for step in group if is_open(box, step)]
        if steps:
            self.have_unsafe(np.array([self.settings_at_end(box, step) for box, step in steps]))
        return [step for box, step in steps if is_open(box, step)]

    def settings_at_end(self, sides: FloatArray, step: Step) -> FloatArray:
        """Settings at the end of one side of a box, all other values in the box."""
        side, column = step
        settings = np.concatenate(
            [self.corner_settings(sides[np.newaxis])[0], self.points(sides, SLAB_POINTS)]
        )
        settings[:, column] = self.box(sides).end(side, column)
        return settings

    def best(self, start: FloatArray) -> FloatArray:
        """The largest box within `start` in which no search finds anything unsafe, moved out as far
        as it can be, or the last of `MAX_ATTEMPTS` boxes.
        """
        sides = start
        for _ in range(self._attempts):
            sides = self.largest(sides, start)
            found = self.failures_in(sides)
            if not len(found):
                sides = self.widened(sides)
                found = self.failures_in(sides)
            if not len(found):
                break
            self.learn(found)
        return sides
