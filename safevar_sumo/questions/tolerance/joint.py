"""The largest box in which characteristics may vary together, with limits that the user specifies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator, Interval
from safevar_sumo.questions.tolerance.boxes import corners_of, sample_box, sobol_and_corners
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Limit
from safevar_sumo.sumo.system import assemble

PARTS, ROUNDS = 8, 3
"""Each of `ROUNDS` rounds divides the interval from a safe to an unsafe size of a box into `PARTS` parts."""
WIDENING = 0.04
"""Share of its domain by which a side of the box is widened in search of something unsafe."""
MAX_GAP = 0.05
"""A free side ends at most this share of the domain before something unsafe, or the domain's end; a little more than
`WIDENING`.
"""
SEARCH_POINTS = 256
"""Number of Sobol points, and of corners, at which a box is searched for something unsafe."""
SLAB_POINTS = 64
"""Number of Sobol points, and of corners, at which the room beside a box is searched."""
MAX_ATTEMPTS = 40
"""Maximum number of boxes that are searched for something unsafe, and of tests."""
DEVIATIONS = tuple(0.35 * 0.7**k for k in range(9))
"""Standard deviations of the steps by which a random search changes a box, round by round, as shares of the domain."""
PROPOSALS = 4096
"""Number of boxes that a round of the random search proposes."""
BATCH, LEAST_BATCH = 512, 64
"""Simulations, at all points of a study's matrix, that cost hardly more than one; fewest settings of a batch."""
LEAST_GAIN = 0.01
"""Least gain in the logarithm of the volume for which a proposed box is simulated."""
UNDONE_AT_ONCE = 4
"""Number of changes of a setting of which all combinations are undone in one batch, in search of its causes."""
ROUNDING = 1e-9
"""Rounding errors of a setting, as a share of the domain."""
STAGE = "limits together"
Step = Sequence[int]
"""A side of a box, below or above, and the column of its characteristic."""


class JointLimits(NamedTuple):
    """The largest box that was found, by relative volume, in which characteristics reach the limits specified for them.

    Attributes
    ----------
    box
        The interval of each characteristic, rounded inwards to the digits that are printed.
    samples, unsafe, failed
        Number of settings drawn at random in the box, of the unsafe ones, and of those that could not be simulated.
    at_most
        With 95 % confidence, at most this share of all settings in the box is unsafe or cannot be simulated.
    kept
        False if no box is safe: settings within the limits are unsafe, all other characteristics as in the original, or
        without limits no box but the original was found.
        In the box, the other characteristics then keep their original values.
    beyond
        By the name of a characteristic, an unsafe setting whose value of it is just beyond the box; all its other
        values are in the box.
    """

    box: Mapping[str, Interval]
    samples: int
    unsafe: int
    failed: int
    at_most: float
    kept: bool
    beyond: Mapping[str, FloatArray]


class _BoxSearch:
    """The search for a box, which is given by its sides: the extents below and above the original, shape (2, n), in the
    units of the characteristics.

    Attributes
    ----------
    width
        Widths of the domains; 0 for a characteristic that does not vary.
    domain
        The extents of the domains.
    limits
        The values of the sides that are at limits, NaN for the free ones.
    is_free
        Which sides may move; the others are at their limits.
    longest
        The longest that each side may be: a free one to the end of its domain, a fixed one to its limit.
    fixed
        The box whose free sides are 0.
    unsafe_settings
        Settings that no box may hold.
    corners
        Corners that were unsafe in some box: for each characteristic -1, the lower end of the box, 0, the original, or
        1, the upper end; for each parameter of the scenario its place between original and end.
    batch
        Number of settings that are simulated at once.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        columns: Sequence[int],
        unsafe: Unsafe,
        limits: Mapping[str, Limit],
        unsafe_settings: FloatArray,
    ) -> None:
        self.evaluator, self.columns, self.unsafe, self.unsafe_settings = evaluator, columns, unsafe, unsafe_settings
        members = evaluator.characteristics
        self.original, is_varied = members.original, np.isin(range(len(members)), columns)
        self.domain = np.stack([self.original - members.lower, members.upper - self.original]) * is_varied
        self.width, self.limits = self.domain.sum(axis=0), np.full_like(self.domain, np.nan)
        for name, limit in limits.items():
            self.limits[:, members.names.index(name)] = limit.at_least, limit.at_most  # None is NaN
        self.is_free = (self.domain > 0) & np.isnan(self.limits)
        self.longest = np.where(np.isnan(self.limits), self.domain, np.abs(self.limits - self.original))
        self.fixed = np.where(self.is_free, 0.0, self.longest)
        self.corners, self.search_count = list[FloatArray](), 0
        self.batch = max(BATCH // len(assemble(evaluator.study).points), LEAST_BATCH)

    def ends(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.original - sides[0], self.original + sides[1]

    def printed_ends(self, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The ends of a box as they are printed: limits and ends of domains exactly, all others rounded inwards."""
        members = self.evaluator.characteristics
        ends = np.array(
            [
                [item.rounded(end, upwards=upwards) for item, end in zip(members, ends, strict=True)]
                for ends, upwards in zip(self.ends(sides), (True, False), strict=True)
            ]
        )
        ends = np.where(sides >= self.domain, np.stack([members.lower, members.upper]), ends)
        ends = np.where(self.domain > 0, ends, self.original)
        lower, upper = np.where(np.isnan(self.limits), ends, self.limits)
        return lower, upper

    def extents(self, settings: FloatArray) -> FloatArray:
        """The sides that a box needs to hold each of K settings, shape (K, 2, n); below 0 where it needs none."""
        change = settings - self.original
        return np.asarray(np.stack([-change, change], axis=1) - ROUNDING * self.width)

    def unsafe_inside(self, sides: FloatArray) -> FloatArray:
        """The known unsafe settings that a box holds."""
        inside = self.unsafe_settings[(self.extents(self.unsafe_settings) <= sides).all(axis=(1, 2))]
        return inside

    def are_unsafe(self, settings: FloatArray) -> BoolArray:
        """Simulate settings, shape (..., n), and remember the unsafe ones: no later box holds one of them."""
        rows = settings.reshape(-1, len(self.original))
        is_unsafe = self.unsafe.of(self.evaluator.evaluate(rows, STAGE))
        self.unsafe_settings = np.concatenate([self.unsafe_settings, rows[is_unsafe]])
        return is_unsafe.reshape(settings.shape[:-1])

    def corner_settings(self, boxes: FloatArray) -> FloatArray:
        """Settings at the C known corners of B boxes, shape (B, C, n)."""
        corners, below, above = np.array(self.corners), boxes[:, :1], boxes[:, 1:]
        return self.original + corners * np.where(corners > 0, above, below)  # a corner of 0 is the original

    def points(self, sides: FloatArray, number: int) -> FloatArray:
        """New Sobol points and corners of a box."""
        self.search_count += 1
        seed = self.evaluator.study.search.seed + self.search_count
        return sobol_and_corners(self.evaluator, self.columns, self.ends(sides), number, seed)

    def attack(self, sides: FloatArray) -> FloatArray:
        """Unsafe settings of a box: the known ones; without any, those that a new search finds."""
        known = self.unsafe_inside(sides)
        if len(known):
            return known
        points = self.points(sides, SEARCH_POINTS)
        found = points[self.are_unsafe(points)]
        return found

    def learn(self, settings: FloatArray) -> None:
        """Add corners that are unsafe, from some of these unsafe settings.

        One by one, as many changes of a setting as possible are undone while it stays unsafe; the directions of the
        remaining changes are the corner. All combinations of the next few are simulated at once.
        """
        number = min(len(settings), self.batch // 2**UNDONE_AT_ONCE)
        causes, columns = settings[:: len(settings) // number][:number].copy(), np.flatnonzero(self.is_free.any(axis=0))
        for start in range(0, len(columns), UNDONE_AT_ONCE):
            group = columns[start : start + UNDONE_AT_ONCE]
            bits = 1 << np.arange(len(group))
            is_undone = np.zeros((2 ** len(group), len(self.original)), dtype=bool)
            is_undone[:, group] = np.arange(2 ** len(group))[:, np.newaxis] & bits
            variants = np.where(is_undone, self.original, causes[:, np.newaxis])
            for cause, of_cause, is_unsafe in zip(causes, variants, self.are_unsafe(variants), strict=True):
                chosen = 0
                for bit in bits:
                    chosen += bit * is_unsafe[chosen + bit]
                cause[:] = of_cause[chosen]
        changes, is_vehicle = causes - self.original, self.evaluator.characteristics.of_vehicle
        sides = np.where(changes > 0, self.domain[1], self.domain[0])
        shares = np.divide(changes, sides, out=np.zeros_like(changes), where=sides > 0)
        corners = np.where(is_vehicle, np.sign(changes), shares)  # of the vehicle, in the encounter of the cause
        known = {corner.tobytes(): corner for corner in [*self.corners, *corners]}
        self.corners = list(known.values())
        # A box that holds a setting with more than a cause's changes holds the cause.
        needs = np.maximum(self.extents(self.unsafe_settings), 0.0)
        for cause in np.maximum(self.extents(causes), 0.0):
            needs, self.unsafe_settings = (
                rows[~(needs >= cause).all(axis=(1, 2))] for rows in (needs, self.unsafe_settings)
            )
        self.unsafe_settings = np.concatenate([self.unsafe_settings, np.unique(causes, axis=0)])

    def are_safe(self, boxes: FloatArray) -> BoolArray:
        """Which of B boxes, shape (B, 2, n), are safe at the known corners."""
        return np.asarray(~self.are_unsafe(self.corner_settings(boxes)).any(axis=1))

    def largest(self, sides: FloatArray, start: FloatArray) -> FloatArray:
        """A box within `start` that is safe at the known corners, and holds no known unsafe setting, as large as a
        random search makes it.

        `sides` first shrink as a whole until they are safe. Larger boxes nearby are then simulated at their corners.
        """
        rng = np.random.default_rng((self.evaluator.study.search.seed, 2))
        low, high = 0.0, 1.0
        for _ in range(ROUNDS):
            shares = [low, *(low + (high - low) * np.arange(1, PARTS + 1) / PARTS).tolist()]
            boxes = np.where(self.is_free, np.array(shares[1:])[:, np.newaxis, np.newaxis] * sides, start)
            is_safe = self.are_safe(boxes) & [not len(self.unsafe_inside(box)) for box in boxes]
            safe_count = int(np.argmin([*is_safe, False]))  # the smallest ones, before the first unsafe
            low, high = shares[safe_count], shares[min(safe_count + 1, PARTS)]
        best = np.where(self.is_free, low * sides, start)
        for deviation in DEVIATIONS:
            shape = (PROPOSALS, *start.shape)
            is_moved = rng.random(shape) < rng.random((PROPOSALS, 1, 1))
            steps = rng.normal(0.0, deviation, shape) * is_moved
            boxes = np.where(self.is_free, np.clip(best + steps * self.width, 0.0, start), start)
            boxes = boxes[self._log_volume(boxes) > self._log_volume(best) + LEAST_GAIN]
            known = self.extents(self.unsafe_inside(boxes.max(axis=0, initial=0.0)))
            possible = (box for box in boxes if not (known <= box).all(axis=(1, 2)).any())
            chosen = [*islice(possible, max(self.batch // len(self.corners), 1))]
            if chosen and (is_safe := self.are_safe(boxes := np.array(chosen))).any():
                best = max(boxes[is_safe], key=self._log_volume)
        return best

    def _log_volume(self, boxes: FloatArray) -> FloatArray:
        """The logarithm of the volume of boxes, shape (..., 2, n), as a share of the domain's."""
        shares = np.divide(boxes.sum(axis=-2), self.width, out=np.ones_like(boxes[..., 0, :]), where=self.width > 0)
        return np.asarray(np.sum(np.log(np.maximum(shares, 1e-9)), axis=-1))  # finite for a width of 0, too

    def widened(self, sides: FloatArray) -> FloatArray:
        """Move the free sides of a box outwards in steps, until something unsafe is in the next step of each or the
        domain ends. Sides move together where their steps together are safe, too.
        """
        steps: list[Step] = [*np.argwhere(self.is_free & (sides < self.longest)).tolist()]
        while steps := self.safe_steps(sides, [[step] for step in steps]):
            sides = self.wider(sides, self.safe_steps(sides, [steps]) or steps[:1], WIDENING)
            steps = [step for step in steps if sides[*step] < self.longest[*step]]
        return sides

    def safe_steps(self, sides: FloatArray, groups: Sequence[Sequence[Step]]) -> list[Step]:
        """The steps outwards in which nothing unsafe is found; those of a group are made together."""

        def is_open(box: FloatArray, step: Step) -> bool:
            side, column = step
            return not (self.extents(self.unsafe_inside(box))[:, side, column] > sides[side, column]).any()

        boxes = [(self.wider(sides, group, WIDENING), group) for group in groups]
        steps = [(box, step) for box, group in boxes for step in group if is_open(box, step)]
        if steps:
            self.are_unsafe(np.concatenate([self.settings_at_end(box, step) for box, step in steps]))
        return [step for box, step in steps if is_open(box, step)]

    def wider(self, sides: FloatArray, steps: Sequence[Step], share: float) -> FloatArray:
        """A box with some sides moved outwards by a share of the domain, at most to its end."""
        wider = sides.copy()
        for side, column in steps:
            wider[side, column] = min(sides[side, column] + share * self.width[column], self.domain[side, column])
        return wider

    def settings_at_end(self, sides: FloatArray, step: Step) -> FloatArray:
        """Settings at the end of one side of a box, all other values in the box."""
        side, column = step
        settings = np.concatenate([self.corner_settings(sides[np.newaxis])[0], self.points(sides, SLAB_POINTS)])
        settings[:, column] = self.ends(sides)[side][column]
        return settings

    def best(self, start: FloatArray) -> FloatArray:
        """The largest box within `start` in which no search finds anything unsafe, widened as far as it can be.

        If every search finds something, the box keeps all but the fixed sides at the original.
        """
        sides = start
        for _ in range(MAX_ATTEMPTS):
            sides = self.largest(sides, start)
            found = self.attack(sides)
            if not len(found):
                sides = self.widened(sides)
                found = self.attack(sides)
            if not len(found):
                return sides
            self.learn(found)
        return self.fixed

    def beyond(self, sides: FloatArray) -> dict[str, FloatArray]:
        """For each characteristic, an unsafe setting in which it alone is beyond a box, by at most `MAX_GAP`."""
        beyond = dict[str, FloatArray]()
        boxes = [(self.wider(sides, [step], MAX_GAP), step) for step in np.argwhere(sides < self.domain).tolist()]
        at_ends = [self.settings_at_end(box, step) for box, step in boxes if not self.is_free[*step]]
        self.are_unsafe(np.array(at_ends).reshape(-1, len(self.original)))
        for box, (_, column) in boxes:
            for setting in self.unsafe_inside(box)[:1]:
                beyond.setdefault(self.evaluator.characteristics.names[column], setting)
        return beyond


def find_joint_limits(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    limits: Mapping[str, Limit],
    scans: Sequence[OneAtATimeScan],
    unsafe_settings: FloatArray,
) -> JointLimits:
    """The largest box by relative volume in which `columns` vary, and in which those of `limits` reach their limits.

    The box holds none of `unsafe_settings`, shape (K, n).

    Notes
    -----
    A random search seeks the largest box that is safe at known corners, within what is safe alone; at first at that
    corner alone where every characteristic has gone towards its smaller margin. A search then attacks the box. Causes
    of what is unsafe, as few changes as possible, are further corners, and the box is sought anew until no search finds
    anything. Sides that could go further are widened. At last all corners of the box as it is printed, and independent
    settings, test it (`sample_box`).
    """
    unverified = evaluator.for_study(evaluator.study, verified=0)  # many small batches; the test of the box is verified
    search = _BoxSearch(unverified, columns, unsafe, limits, unsafe_settings)
    start, corner = search.longest.copy(), np.zeros(len(search.original))
    for column, scan in zip(columns, scans, strict=False):  # parameters of the scenario, which come last, have no scan
        original = search.original[column]
        low, high = scan.safe or (original, original)
        safe_alone = np.minimum(start[:, column], (original - low, high - original))
        start[:, column] = np.where(search.is_free[:, column], safe_alone, start[:, column])
        low_degree, high_degree = np.nan_to_num([scan.degree(end) for end in (low, high)], nan=np.inf)
        corner[column] = -1.0 if low_degree < high_degree else 1.0
    search.corners.append(corner)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        kept = not len(search.attack(search.fixed))
        # The last attempt gives up: it tests the limits alone, with all others as in the original.
        sides = search.best(start) if kept and attempt < MAX_ATTEMPTS else search.fixed
        ends, stream = search.printed_ends(sides), (evaluator.study.search.seed, 1, attempt)
        stage = "test of the limits together"
        corners = corners_of(evaluator, columns, ends, attempt)
        unsafe_corners = corners[unsafe.of(evaluator.evaluate(corners, stage))]
        unsafe_samples, count, failed, at_most = sample_box(evaluator, columns, unsafe, ends, attempt, stream, stage)
        unsafe_inside = np.concatenate([unsafe_corners, unsafe_samples])
        if not kept or not len(unsafe_inside):
            break
        search.unsafe_settings = np.concatenate([search.unsafe_settings, unsafe_inside])
        search.learn(unsafe_inside)
    else:
        kept = False
    of_vehicle = evaluator.characteristics.of_vehicle
    if np.isnan(search.limits[:, of_vehicle]).all():  # the original alone is no box
        kept = kept and bool((sides[:, of_vehicle] > 0).any())
    lower, upper = (values.tolist() for values in ends)
    return JointLimits(
        box=dict(zip(evaluator.characteristics.names, zip(lower, upper, strict=True), strict=True)),
        samples=count,
        unsafe=len(unsafe_samples),
        failed=failed,
        at_most=at_most,
        kept=kept,
        beyond=search.beyond(sides) if kept else {},
    )
