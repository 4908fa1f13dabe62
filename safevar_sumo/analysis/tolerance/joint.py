"""The largest box in which characteristics may vary together while some are held to limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, Interval
from safevar_sumo.analysis.tolerance.boxes import FIRST_SEARCH_POINTS, sample_box, sobol_and_corners
from safevar_sumo.analysis.tolerance.scans import OneAtATimeScan
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Limit

PARTS, ROUNDS = 8, 3
"""Parts into which each round divides the share of a box that is safe."""
WIDER = 0.04
"""Share of its domain by which a side of the box is widened in search of something unsafe."""
SLAB_POINTS = 64
"""Number of Sobol points, and of corners, at which the room beside a box is searched."""
MAX_ROUNDS = 40
"""Maximum number of boxes that are searched for something unsafe, and of tests."""
DEVIATIONS = tuple(0.35 * 0.8**k for k in range(14))
"""Standard deviations of the steps by which a random search changes a box, round by round, as shares of the domain."""
PROPOSALS, SIMULATED_CORNERS, LEAST_GAIN = 4096, 64, 0.01
"""Boxes proposed in a round, the number of corners simulated, and the gain in volume (logarithm) that is worth it."""
CAUSES_PER_ROUND = 4
"""Approximate number of unsafe settings of a search whose causes are sought."""
ROUNDING = 1e-9
"""Rounding errors of a setting, as a share of the domain."""
STAGE = "limits together"


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
    samples: int
    unsafe: int
    failed: int
    at_most: float
    known_unsafe_inside: int
    kept: bool
    beyond: Mapping[str, FloatArray]

    def to_dict(self) -> JsonObject:
        """The last record of `tolerance --limits --json`."""
        record = {name: value for name, value in self._asdict().items() if name not in ("failed", "beyond")}
        record["fixed"] = {name: [limit.at_least, limit.at_most] for name, limit in self.fixed.items()}
        return {"joint": record}

    @property
    def in_words(self) -> str:
        """The result of the box's test."""
        bound = f"with {100 * CONFIDENCE:.0f} % confidence at most {100 * self.at_most:.2f} % of all are"
        if not self.kept:
            drawn = f"{self.unsafe} of {self.samples} settings drawn at random"
            return (
                f"The limits are not kept: {drawn if self.unsafe else 'settings that a search found'} within them, all "
                f"other characteristics as in the original, are unsafe; {bound}."
            )
        return (
            "With the specified limits, the limits with all others at theirs are the largest box by volume that was "
            f"found. None of {self.samples} settings drawn at random in it is unsafe; {bound}."
        )


class _Search:
    """The search for a box: its sides are extents below and above the original, shape (2, n), in the table's units.

    `room` are the extents of the domain, `free` the sides that may move. `found` are unsafe settings, which no box may
    hold. `corners` were unsafe in some box, as -1, 0 or 1 for each characteristic.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        columns: Sequence[int],
        unsafe: Unsafe,
        limits: Mapping[str, Limit],
        found: FloatArray,
    ) -> None:
        self.evaluator, self.columns, self.unsafe, self.found = evaluator, columns, unsafe, found
        one = evaluator.characteristics
        self.original, varied = one.original, np.isin(range(len(one)), columns)
        self.room = np.stack([one.original - one.lower, one.upper - one.original]) * varied
        self.width, self.free = self.room.sum(axis=0), self.room > 0
        for column, limit in ((one.names.index(name), limit) for name, limit in limits.items()):
            for side, value in enumerate((limit.at_least, limit.at_most)):
                if value is not None:
                    self.free[side, column], self.room[side, column] = False, abs(value - one.original[column])
        self.fixed = np.where(self.free, 0.0, self.room)
        self.corners, self.searches = list[FloatArray](), 0

    def ends(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.original - sides[0], self.original + sides[1]

    def hold(self, boxes: FloatArray, settings: FloatArray) -> BoolArray:
        """Which of B boxes, shape (B, 2, n), hold which of K settings; shape (B, K)."""
        change = settings - self.original
        extents = np.stack([-change, change], axis=1) - ROUNDING * self.width
        return np.array([(extents <= sides).all(axis=(1, 2)) for sides in boxes]).reshape(len(boxes), len(settings))

    def find_unsafe(self, settings: FloatArray) -> FloatArray:
        """Those of the settings that are unsafe; no later box holds one of them."""
        found = settings[self.unsafe.of(self.evaluator.evaluate(settings, STAGE))]
        self.found = np.concatenate([self.found, found])
        return found

    def corner_settings(self, boxes: FloatArray) -> FloatArray:
        """Settings at the C known corners of B boxes, shape (B, C, n)."""
        corners = np.array(self.corners)
        return self.original + np.where(corners > 0, boxes[:, 1:], corners * boxes[:, :1])

    def points(self, sides: FloatArray, number: int) -> FloatArray:
        """New Sobol points and corners of a box."""
        self.searches += 1
        seed = self.evaluator.study.search.seed + self.searches
        return sobol_and_corners(self.evaluator, self.columns, self.ends(sides), number, seed)

    def attack(self, sides: FloatArray) -> FloatArray:
        """Unsafe settings of a box: known ones, else those of a search."""
        known = self.found[self.hold(sides[np.newaxis], self.found)[0]]
        return known if len(known) else self.find_unsafe(self.points(sides, FIRST_SEARCH_POINTS))

    def learn(self, found: FloatArray) -> None:
        """Add the corners at which some unsafe settings lie: as few changes as possible, all others as in the
        original.
        """
        for setting in found[:: max(len(found) // CAUSES_PER_ROUND, 1)]:
            cause = setting
            for column in np.flatnonzero((setting != self.original) & self.free.any(axis=0)):
                less = cause.copy()
                less[column] = self.original[column]
                cause = less if len(self.find_unsafe(less[np.newaxis])) else cause
            corner = np.sign(cause - self.original)
            if not any((corner == known).all() for known in self.corners):
                self.corners.append(corner)

    def are_safe(self, boxes: FloatArray) -> BoolArray:
        """Which of B boxes, shape (B, 2, n), are safe at the known corners and hold no unsafe setting found so far."""
        are_open: BoolArray = ~np.any(self.hold(boxes, self.found), axis=1)
        settings = self.corner_settings(boxes[are_open])
        is_unsafe = self.unsafe.of(self.evaluator.evaluate(np.concatenate([self.found[:0], *settings]), STAGE))
        is_unsafe = is_unsafe.reshape(settings.shape[:2])
        self.found = np.concatenate([self.found, settings[is_unsafe]])
        are_open[are_open] = ~is_unsafe.any(axis=1)
        return are_open

    def largest(self, start: FloatArray) -> FloatArray:
        """A box within `start` that is safe at the known corners, as large as a random search makes it.

        The box first shrinks as a whole. Boxes nearby that are larger and hold no unsafe setting known so far are then
        simulated at their corners.
        """
        rng = np.random.default_rng((self.evaluator.study.search.seed, 2))
        low, high = 0.0, 1.0
        for _ in range(ROUNDS):
            shares = low + (high - low) * np.arange(1, PARTS + 1) / PARTS
            is_safe = self.are_safe(np.where(self.free, shares[:, np.newaxis, np.newaxis] * start, start))
            first = PARTS if is_safe.all() else int(np.argmin(is_safe))
            low, high = (float(shares[first - 1]) if first else low), float(shares[min(first, PARTS - 1)])
        best = np.where(self.free, low * start, start)
        for deviation in DEVIATIONS:
            shape = (PROPOSALS, *start.shape)
            steps = rng.normal(0.0, deviation, shape) * (rng.random(shape) < 0.5)
            boxes = np.where(self.free, np.clip(best + steps * self.width, 0.0, start), start)
            boxes = boxes[self._log_volume(boxes) > self._log_volume(best) + LEAST_GAIN]
            boxes = boxes[~np.any(self.hold(boxes, self.found), axis=1)]
            boxes = boxes[: max(SIMULATED_CORNERS // len(self.corners), 1)]
            safe = boxes[self.are_safe(boxes)]
            if len(safe):
                best = safe[int(np.argmax(self._log_volume(safe)))]
        return best

    def _log_volume(self, boxes: FloatArray) -> FloatArray:
        """The logarithm of the volume of boxes, shape (..., 2, n), as a share of the domain's."""
        shares = np.divide(boxes.sum(axis=-2), self.width, out=np.ones_like(boxes[..., 0, :]), where=self.width > 0)
        return np.asarray(np.sum(np.log(np.maximum(shares, 1e-9)), axis=-1))

    def widened(self, sides: FloatArray) -> FloatArray:
        """The box with each free side as wide as it can be: something unsafe or the domain's end is at most 5 % of the
        domain away.
        """
        for side in zip(*np.nonzero(self.free & (sides < self.room)), strict=True):
            while sides[side] < self.room[side]:
                wider = sides.copy()
                wider[side] = min(sides[side] + WIDER * self.width[side[1]], self.room[side])
                slab = np.concatenate([self.corner_settings(wider[np.newaxis])[0], self.points(wider, SLAB_POINTS)])
                slab[:, side[1]] = self.ends(wider)[side[0]][side[1]]
                if self.hold(wider[np.newaxis], self.found).any() or len(self.find_unsafe(slab)):
                    break
                sides = wider
        return sides

    def best(self, start: FloatArray) -> FloatArray:
        """The largest box within `start` in which no search finds anything unsafe, and that cannot be widened; without
        room beside the limits if searches go on finding something.
        """
        for _ in range(MAX_ROUNDS):
            sides = self.largest(start)
            if not len(found := self.attack(sides)):
                sides = self.widened(sides)
                found = self.attack(sides)
            if not len(found):
                return sides
            self.learn(found)
        return self.fixed

    def beyond(self, sides: FloatArray) -> dict[str, FloatArray]:
        """An unsafe setting for each characteristic that alone is beyond a box, by at most 5 % of its domain."""
        beyond = dict[str, FloatArray]()
        for side, column in zip(*np.nonzero(self.free & (sides < self.room)), strict=True):
            wider = sides.copy()
            wider[side, column] += 0.05 * self.width[column]
            for setting in self.found[self.hold(wider[np.newaxis], self.found)[0]][:1]:
                beyond.setdefault(self.evaluator.characteristics.names[column], setting)
        return beyond


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
    The largest box is sought by a random search among those that are safe at known corners, within what is safe alone;
    at first, only the corner of the sides with the smallest margins is known. A search then attacks the box, at Sobol
    points and at other corners. The causes of what is unsafe, as few changes as possible, are further corners, and the
    largest box is sought anew, until no search finds anything. Sides that could go further are widened, and the box is
    tested with independent settings (`sample_box`).
    """
    unverified = evaluator.for_study(evaluator.study, verified=0)  # many small batches; the test of the box is verified
    search = _Search(unverified, columns, unsafe, limits, np.concatenate([unsafe_settings, known]))
    start, corner = search.room.copy(), np.zeros(len(search.original))
    for column, scan in zip(columns, scans, strict=True):
        (low, high), (low_margin, high_margin) = scan.safe or search.original[[column, column]], scan.margins
        alone = search.original[column] - low, high - search.original[column]
        start[:, column] = np.where(search.free[:, column], np.minimum(start[:, column], alone), start[:, column])
        corner[column] = -1.0 if low_margin is not None and (high_margin is None or low_margin < high_margin) else 1.0
    search.corners.append(corner)
    for attempt in range(1, MAX_ROUNDS + 1):
        kept = attempt < MAX_ROUNDS and not len(search.attack(search.fixed))
        sides = search.best(start) if kept else search.fixed
        ends, stream = search.ends(sides), (evaluator.study.search.seed, 1, attempt)
        stage = "test of the limits together"
        found, samples, failed, at_most = sample_box(evaluator, columns, unsafe, ends, attempt, stream, stage)
        if not (kept and len(found)):
            break
        search.found = np.concatenate([search.found, found])
        search.learn(found[:1])
    # Ends of the domain are stated exactly, not through their distance from the original.
    box = {
        one.name: (max(low, one.lower), min(high, one.upper))
        for one, low, high in zip(evaluator.characteristics, *(end.tolist() for end in ends), strict=True)
    }
    inside = int(search.hold(sides[np.newaxis], known).sum())
    return JointLimits(limits, box, samples, len(found), failed, at_most, inside, kept, search.beyond(sides))
