"""The largest box in which characteristics may vary together while some are held to limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import Evaluator, Interval, sobol_points
from safevar_sumo.analysis.tolerance.boxes import (
    FIRST_SEARCH_POINTS,
    STEP_BACK,
    plan_test,
    random_settings,
    settings_in_box,
)
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Limit

PARTS, ROUNDS = 8, 3
"""Parts into which each round divides an interval between a safe and an unsafe setting."""
WIDER = 0.04
"""Share of its domain by which a side of the box is widened in search of something unsafe."""
SLAB_POINTS = 64
"""Number of Sobol points, and of corners, at which the room beside a box is searched."""
MAX_ROUNDS = 40
"""Maximum number of times that a box is searched, and of tests of boxes."""
DEVIATIONS = tuple(0.35 * 0.8**k for k in range(14))
"""Standard deviations of the steps by which a random search changes a box, round by round, as shares of the domain."""
PROPOSALS, SIMULATED_BOXES, LEAST_GAIN = 4096, 64, 0.01
"""Boxes proposed in a round, the number of corners simulated, and the gain in volume (logarithm) that is worth it."""
CAUSES_PER_ROUND = 4
"""Approximate number of unsafe settings of a search that a box shrinks for at once."""
ROUNDING = 1e-9
"""Rounding errors of a setting, as a share of the domain."""
RESTARTS = 6
"""Maximum number of times that the largest box at all corners known is sought anew."""
STAGE = "limits together"


def _log_volume(boxes: FloatArray, width: FloatArray) -> FloatArray:
    """The logarithm of the volume of boxes, shape (..., 2, n), as a share of the domain's."""
    shares = np.divide(boxes.sum(axis=-2), width, out=np.ones_like(boxes[..., 0, :]), where=width > 0)
    return np.asarray(np.sum(np.log(np.maximum(shares, 1e-9)), axis=-1))


class JointLimits(NamedTuple):
    """The largest box found by relative volume in which the characteristics of `fixed` reach their limits.

    Of `samples` settings drawn at random in it, `unsafe` are unsafe, and `failed` could not be simulated; at most the
    share `at_most` of all settings in it are unsafe or cannot be simulated, with 95 % confidence. `kept` is false if
    settings within the limits are unsafe, all other characteristics as in the original; the box then leaves those no
    room. It holds `known_unsafe_inside` unsafe solutions of results. `beyond` are unsafe settings, by the
    characteristic that is just beyond the box, while all others are in it.
    """

    fixed: Mapping[str, Limit]
    box: Mapping[str, Interval]
    kept: bool
    samples: int
    unsafe: int
    failed: int
    at_most: float
    known_unsafe_inside: int
    beyond: Mapping[str, FloatArray]

    def to_dict(self) -> JsonObject:
        """The last record of `tolerance --limits --json`."""
        fixed = {name: [limit.at_least, limit.at_most] for name, limit in self.fixed.items()}
        box = {name: list(ends) for name, ends in self.box.items()}
        rest = ("samples", "unsafe", "at_most", "known_unsafe_inside", "kept")
        return {"joint": {"fixed": fixed, "box": box, **{key: getattr(self, key) for key in rest}}}


@dataclass
class _Search:
    """The search for a box: its sides are extents below and above the original, shape (2, n), in the table's units.

    `room` are the extents of the domain, `free` the sides that may move. `unsafe_found` are unsafe settings, which no
    box may hold; `causes` those that differ from the original in nothing that is not needed. `corners` were unsafe in
    some box, as -1, 0 or 1 for each characteristic.
    """

    evaluator: Evaluator
    columns: Sequence[int]
    unsafe: Unsafe
    room: FloatArray
    free: BoolArray
    unsafe_found: FloatArray
    causes: FloatArray
    corners: list[FloatArray] = field(default_factory=list)
    searches: int = 0

    @property
    def original(self) -> FloatArray:
        return self.evaluator.characteristics.original

    def extents(self, settings: FloatArray) -> FloatArray:
        """How far K settings lie below and above the original, shape (K, 2, n)."""
        change = settings - self.original
        return np.maximum(np.stack([-change, change], axis=1), 0.0)

    def holds(self, sides: FloatArray, settings: FloatArray) -> BoolArray:
        """Which settings a box holds; shape (K,)."""
        return np.asarray((self.extents(settings) <= sides + ROUNDING * self.room.sum(axis=0)).all(axis=(1, 2)))

    def find_unsafe(self, settings: FloatArray) -> FloatArray:
        """Those of the settings that are unsafe; no later box holds one of them."""
        found = settings[self.unsafe.of(self.evaluator.evaluate(settings, STAGE))]
        self.unsafe_found = np.concatenate([self.unsafe_found, found])
        return found

    def corner_settings(self, sides: FloatArray, corners: Sequence[FloatArray]) -> FloatArray:
        """Settings at corners of a box; a characteristic whose sign is 0 is as in the original."""
        return np.array([self.original + np.where(corner > 0, sides[1], corner * sides[0]) for corner in corners])

    def points(self, sides: FloatArray, number: int) -> FloatArray:
        """Sobol points of a box, and first as many corners, or all if these are at most twice as many."""
        self.searches += 1
        sobol = sobol_points(number, len(self.columns), self.evaluator.study.search.seed + self.searches)
        ends, corners = (self.original - sides[0], self.original + sides[1]), np.round(sobol)
        if 2 ** len(self.columns) <= 2 * number:
            corners = np.array(list(product((0.0, 1.0), repeat=len(self.columns))))
        return settings_in_box(self.evaluator, self.columns, *ends, np.concatenate([corners, sobol]))

    def attack(self, sides: FloatArray) -> FloatArray:
        """Unsafe settings of a box: known ones, else at corners that were unsafe before, else those of a search."""
        if len(held := self.unsafe_found[self.holds(sides, self.unsafe_found)]):
            return held
        if self.corners and len(found := self.find_unsafe(self.corner_settings(sides, self.corners))):
            return found
        return self.find_unsafe(self.points(sides, FIRST_SEARCH_POINTS))

    def reduced(self, setting: FloatArray) -> FloatArray:
        """An unsafe setting with as many characteristics as possible as in the original."""
        cause = setting
        for column in np.flatnonzero((setting != self.original) & self.free.any(axis=0)):
            less = cause.copy()
            less[column] = self.original[column]
            cause = less if len(self.find_unsafe(less[np.newaxis])) else cause
        return cause

    def add_causes(self, cause: FloatArray) -> None:
        """Add an unsafe setting to the causes, and the settings in which one characteristic goes back from it as far as
        it remains unsafe.
        """
        columns = np.flatnonzero(((self.extents(cause[np.newaxis])[0] > 0) & self.free).any(axis=0))
        rows, edges = np.arange(len(columns)), np.tile(cause, (len(columns), 1))
        if len(columns):
            starts, low, high = edges.copy(), np.zeros(len(columns)), np.ones(len(columns))
            starts[rows, columns] = self.original[columns]
            for _ in range(ROUNDS):
                shares = low[:, np.newaxis] + (high - low)[:, np.newaxis] * np.arange(PARTS + 1) / PARTS
                inner = starts[:, np.newaxis] + shares[:, 1:-1, np.newaxis] * (cause - starts)[:, np.newaxis]
                evaluations = self.evaluator.evaluate(inner.reshape(-1, len(cause)), STAGE)
                is_unsafe = self.unsafe.of(evaluations).reshape(len(columns), -1)
                first = np.argmax(np.column_stack([is_unsafe, np.ones(len(columns), dtype=bool)]), axis=1)
                low, high = shares[rows, first], shares[rows, first + 1]
            edges = starts + high[:, np.newaxis] * (cause - starts)
        self.causes = np.concatenate([self.causes, cause[np.newaxis], edges])

    def without(self, sides: FloatArray, settings: FloatArray) -> FloatArray | None:
        """The box without some settings, each excluded by the side that costs least volume; None if no side can."""
        while len(inside := settings[self.holds(sides, settings)]):
            extents = self.extents(inside)
            widths = sides.sum(axis=0)
            rest = widths - sides + STEP_BACK * extents
            can = self.free & (extents > 0)
            shares = np.where(can, np.divide(rest, widths, out=np.zeros_like(rest), where=widths > 0), -1.0)
            best = shares.reshape(len(inside), -1).max(axis=1)
            hardest = int(np.argmin(best))
            if best[hardest] < 0:
                return None
            side = np.unravel_index(int(np.argmax(shares[hardest])), sides.shape)
            sides = sides.copy()
            sides[side] = STEP_BACK * extents[hardest][side]
        return sides

    def largest(self, sides: FloatArray) -> FloatArray:
        """A box within `sides` that is safe at the known corners, as large as a random search makes it.

        The box first shrinks as a whole. Boxes nearby that are larger and hold no unsafe setting known so far are then
        simulated at their corners.
        """
        rng, width = np.random.default_rng((self.evaluator.study.search.seed, 2)), self.room.sum(axis=0)
        low, high = 0.0, 1.0
        for _ in range(ROUNDS):
            shares = low + (high - low) * np.arange(1, PARTS + 1) / PARTS
            is_safe = self._safe_boxes([np.where(self.free, share * sides, sides) for share in shares])
            first = PARTS if is_safe.all() else int(np.argmin(is_safe))
            low, high = (float(shares[first - 1]) if first else low), float(shares[min(first, PARTS - 1)])
        best = np.where(self.free, low * sides, sides)
        for deviation in DEVIATIONS:
            steps = rng.normal(0.0, deviation, (PROPOSALS, *sides.shape)) * (
                rng.random((PROPOSALS, *sides.shape)) < 0.5
            )
            boxes = np.where(self.free, np.clip(best + steps * width, 0.0, sides), sides)
            boxes = boxes[_log_volume(boxes, width) > _log_volume(best, width) + LEAST_GAIN]
            extents = self.extents(self.unsafe_found)
            is_open = [not (extents <= box).all(axis=(1, 2)).any() for box in boxes]
            boxes = boxes[is_open][: max(SIMULATED_BOXES // len(self.corners), 1)]
            if not len(boxes):
                continue
            safe = boxes[self._safe_boxes(boxes)]
            if len(safe):
                best = safe[int(np.argmax(_log_volume(safe, width)))]
        return best

    def _safe_boxes(self, boxes: Sequence[FloatArray] | FloatArray) -> BoolArray:
        """Which boxes are safe at the known corners."""
        settings = np.concatenate([self.corner_settings(box, self.corners) for box in boxes])
        is_unsafe = self.unsafe.of(self.evaluator.evaluate(settings, STAGE))
        self.unsafe_found = np.concatenate([self.unsafe_found, settings[is_unsafe]])
        return np.asarray(~is_unsafe.reshape(len(boxes), -1).any(axis=1))

    def learn(self, sides: FloatArray, found: FloatArray) -> FloatArray | None:
        """The box without causes of some unsafe settings found in it; None if the fixed sides alone are unsafe."""
        smaller: FloatArray | None = sides
        for setting in found[:: max(len(found) // CAUSES_PER_ROUND, 1)]:
            if smaller is None or not self.holds(smaller, setting[np.newaxis])[0]:
                continue
            cause = self.reduced(setting)
            if not any((np.sign(cause - self.original) == corner).all() for corner in self.corners):
                self.corners.append(np.sign(cause - self.original))
            self.add_causes(cause)
            smaller = self.without(smaller, self.causes)
        return smaller

    def shrunk(self, sides: FloatArray) -> FloatArray | None:
        """A box in which no search finds anything unsafe any more; None if the fixed sides alone are unsafe."""
        rounds = 0
        while len(found := self.attack(sides)):
            smaller = self.learn(sides, found)
            if smaller is None:
                return None
            rounds += 1
            sides = smaller if rounds < MAX_ROUNDS else np.where(self.free, smaller * (1 - WIDER), smaller)
        return sides

    def best(self, start: FloatArray | None) -> FloatArray | None:
        """The largest box within `start` in which no search finds anything unsafe, and that cannot be widened."""
        if start is None:
            return None
        for _ in range(RESTARTS):  # the first boxes show at which corners something is unsafe
            sides = self.largest(start)
            if not len(found := self.attack(sides)):
                break
            self.learn(sides, found)
        smaller = self.shrunk(sides)
        return None if smaller is None else self.shrunk(self.widened(smaller))

    def widened(self, sides: FloatArray) -> FloatArray:
        """The box with each free side as wide as it can be: something unsafe or the domain's end is at most 5 % of the
        domain away.
        """
        width = self.room.sum(axis=0)
        for side in zip(*np.nonzero(self.free & (sides < self.room)), strict=True):
            while sides[side] < self.room[side]:
                wider = sides.copy()
                wider[side] = min(sides[side] + WIDER * width[side[1]], self.room[side])
                if self.holds(wider, self.unsafe_found).any():
                    break
                sign = 1.0 if side[0] else -1.0
                slab = self.points(wider, SLAB_POINTS)
                slab[:, side[1]] = self.original[side[1]] + sign * wider[side]
                corners = [corner for corner in self.corners if corner[side[1]] == sign]
                settings = np.concatenate([self.corner_settings(wider, corners), slab]) if corners else slab
                if len(self.find_unsafe(settings)):
                    break
                sides = wider
        return sides

    def beyond(self, sides: FloatArray) -> dict[str, FloatArray]:
        """An unsafe setting for each characteristic that alone is beyond a box, by at most 5 % of its domain."""
        found, width = dict[str, FloatArray](), self.room.sum(axis=0)
        for side, column in zip(*np.nonzero(self.free & (sides < self.room)), strict=True):
            wider = sides.copy()
            wider[side, column] += 0.05 * width[column]
            inside = self.unsafe_found[self.holds(wider, self.unsafe_found)]
            if len(inside):
                found.setdefault(self.evaluator.characteristics.names[column], inside[0])
        return found


def find_joint_limits(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    limits: Mapping[str, Limit],
    scans: Sequence[OneAtATimeScan],
    unsafe_settings: FloatArray,
    known: FloatArray,
) -> JointLimits:
    """The largest box by relative volume in which `columns` vary, and in which those of `limits` reach their limits.

    The box holds none of `unsafe_settings`, shape (K, n), and none of the unsafe solutions of a search, `known`, shape
    (L, n).

    Notes
    -----
    The box begins with what is safe alone. Its unsafe corner tells by how much each side would have to shrink alone to
    make it safe; sides in proportion to these losses give the largest box where safety is linear. A search then attacks
    the box: at corners that were unsafe before, at Sobol points and at other corners. Each unsafe setting is excluded
    by the side that costs least volume, until the search finds nothing. Sides that could go further are widened, and
    the box is tested with independent settings as in `find_safe_box`, whose error probabilities hold here, too.
    """
    characteristics, varied = evaluator.characteristics, np.zeros(len(evaluator.characteristics), dtype=bool)
    varied[list(columns)] = True
    below, above = characteristics.original - characteristics.lower, characteristics.upper - characteristics.original
    room = np.where(varied, np.stack([below, above]), 0.0)
    fixed = np.zeros(room.shape, dtype=bool)
    for name, limit in limits.items():
        column = characteristics.names.index(name)
        for side, value in enumerate((limit.at_least, limit.at_most)):
            if value is not None:
                fixed[side, column], room[side, column] = True, abs(value - characteristics.original[column])
    both = np.concatenate([unsafe_settings, known])
    unverified = evaluator.for_study(evaluator.study, verified=0)  # many small batches; the test of the box is verified
    search = _Search(unverified, columns, unsafe, room, ~fixed & (room > 0), both, both)
    only_fixed, seed, attempt = np.where(fixed, room, 0.0), evaluator.study.search.seed, 1
    sides = None
    if not only_fixed.any() or not (search.holds(only_fixed, both).any() or len(search.attack(only_fixed))):
        corner = np.zeros(len(characteristics))
        for column, (low, high) in zip(columns, (scan.margins for scan in scans), strict=True):
            corner[column] = -1.0 if low is not None and (high is None or low < high) else 1.0
        search.corners.append(corner)
        sides = search.best(search.without(room, unsafe_settings))
    while sides is not None and attempt <= MAX_ROUNDS:
        error_probability, samples = plan_test(attempt)
        counts = _test(evaluator, search, sides, samples, np.random.default_rng((seed, 1, attempt)))
        if not counts[1]:
            return _joint_limits(search, limits, sides, known, counts, error_probability, kept=True)
        sides, attempt = search.shrunk(sides), attempt + 1
    error_probability, samples = plan_test(attempt)
    counts = _test(evaluator, search, only_fixed, samples, np.random.default_rng((seed, 1, attempt)))
    return _joint_limits(search, limits, only_fixed, known, counts, error_probability, kept=False)


def _test(
    evaluator: Evaluator, search: _Search, sides: FloatArray, samples: int, rng: np.random.Generator
) -> tuple[int, int, int]:
    """Numbers of random settings in a box, of unsafe ones, and of those that could not be simulated."""
    ends = search.original - sides[0], search.original + sides[1]
    settings = random_settings(evaluator, search.columns, *ends, samples, rng)
    evaluations = evaluator.evaluate(settings, "test of the limits together")
    is_unsafe = search.unsafe.of(evaluations)
    search.unsafe_found = np.concatenate([search.unsafe_found, settings[is_unsafe]])
    for setting in settings[is_unsafe][:1]:
        search.add_causes(search.reduced(setting))
    return len(settings), int(is_unsafe.sum()), int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))


def _joint_limits(
    search: _Search,
    limits: Mapping[str, Limit],
    sides: FloatArray,
    known: FloatArray,
    counts: tuple[int, int, int],
    error_probability: float,
    *,
    kept: bool,
) -> JointLimits:
    samples, unsafe, failed = counts
    bad, good = unsafe + failed, samples - unsafe - failed
    at_most = float(scipy.stats.beta.ppf(1 - error_probability, bad + 1, good)) if good else 1.0
    characteristics = search.evaluator.characteristics
    ends = zip((search.original - sides[0]).tolist(), (search.original + sides[1]).tolist(), strict=True)
    inside = int(search.holds(sides, known).sum())
    # Ends of the domain are stated exactly, not through their distance from the original.
    box = {
        one.name: (max(low, one.lower), min(high, one.upper))
        for one, (low, high) in zip(characteristics, ends, strict=True)
    }
    return JointLimits(limits, box, kept, samples, unsafe, failed, at_most, inside, search.beyond(sides))
