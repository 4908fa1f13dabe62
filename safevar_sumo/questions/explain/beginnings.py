"""The share of the way to the ends of the domain at which changes begin to be a cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import find_boundaries, on_lines
from safevar_sumo.questions.causes import (
    BOUNDARIES,
    Cause,
    directions,
    find_minimal_causes,
    settings_of,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.combinations import Enumeration
from safevar_sumo.records import BoolArray, FloatArray, NamedValues
from safevar_sumo.vehicles import CharacteristicSet

PARTS, COARSE_PARTS = (32, 8), (8, 4)
"""Parts of the way to the ends, as `boundary.PARTS`; and where few simulations are allowed."""
DECIMALS = (2, 3, 4, 15)
"""Decimals of a share of the way: as few as possible."""
PLACES = 20
"""Number of shares at which changes may be safe again."""
VALUE_DIGITS = 12
"""Digits of the values at this share."""


class Beginning(NamedTuple):
    """Where a cause begins.

    Attributes
    ----------
    cause
        The cause, with its values at the ends of the domain or, if these are safe, nearer to the
        original.
    share
        The smallest share of the way to the ends at which it was found to be a cause; NaN if the
        values are at the ends and others were not simulated.
    boundary
        The values there.
    safe_again
        The smallest larger share at which these changes are safe; infinite if none was found.
    """

    cause: Cause
    share: float
    boundary: NamedValues
    safe_again: float


def find_beginnings(
    evaluator: Evaluator, unsafe: Unsafe, steps: Sequence[Enumeration]
) -> list[Beginning]:
    """Where the causes of enumerations at several shares of the way begin, the ends first; and so
    for smaller ones that are found on the way. A cause that contains another one is left out,
    unless both are minimal at the ends.
    """
    members = evaluator.characteristics
    at_ends, *others = steps
    nearer = [(cause, step.share) for step in others for cause in step.causes]
    pending = [(cause, at_ends.share) for cause in at_ends.causes]
    pending += _smallest(members, pending, nearer)
    beginnings = list[Beginning]()
    while pending:
        begun, smaller = _begin(evaluator, unsafe, pending)
        beginnings += begun
        known = [(one.cause, one.share) for one in beginnings]
        pending = _smallest(members, known, smaller)
    return beginnings


def _smallest(
    members: CharacteristicSet,
    known: Sequence[tuple[Cause, float]],
    others: Sequence[tuple[Cause, float]],
) -> list[tuple[Cause, float]]:
    """Those of other causes that contain no known one, nor a smaller one of them."""
    kinds = [{*directions(members, cause.changes)} for cause, _ in known]
    smallest = list[tuple[Cause, float]]()
    for cause, share in sorted(others, key=lambda placed: len(placed[0].changes)):
        kind = {*directions(members, cause.changes)}
        if not any(one <= kind for one in kinds):
            kinds.append(kind)
            smallest.append((cause, share))
    return smallest


def _begin(
    evaluator: Evaluator, unsafe: Unsafe, placed: Sequence[tuple[Cause, float]]
) -> tuple[list[Beginning], list[tuple[Cause, float]]]:
    """Where causes begin, and smaller causes that are unsafe there."""
    # Lines from the original to the ends of the domain, for as many as may be simulated.
    members = evaluator.characteristics
    parts = PARTS if evaluator.left is None else COARSE_PARTS
    sizes = np.array([len(cause.changes) for cause, _ in placed])
    prices = np.cumsum(sum(parts) + len(DECIMALS) + PLACES + 2**sizes)
    # Of few simulations half are left for the neighbours and the other parameter sets.
    number = np.count_nonzero(prices <= evaluator.at_most(int(prices[-1]), 2))
    last = np.array([share for _, share in placed])
    values = settings_of(members, [cause for cause, _ in placed])
    starts = members.with_original_vehicle(values)
    outer = np.where(values > starts, members.upper, members.lower)
    ends = np.where(values == starts, starts, outer)
    lines = _Lines(starts[:number], ends[:number], last[:number])

    def are_unsafe(settings: FloatArray) -> BoolArray:
        return unsafe.of(evaluator.evaluate(settings, BOUNDARIES))

    def are_causes(settings: FloatArray) -> BoolArray:
        """Which are unsafe, and safe with fewer of their changes."""
        flags = are_unsafe(settings)
        rows = settings[flags]
        whole = (members.changed(rows) & members.of_vehicle).sum(axis=1).tolist()
        groups = find_minimal_causes(evaluator, rows, unsafe)
        flags[flags] = [
            any(len(cause.changes) == size for cause in group)
            for group, size in zip(groups, whole, strict=True)
        ]
        return flags

    # Where each is unsafe first. If fewer of its changes are unsafe there, it is a cause later.
    begins = np.where(last < 1, last, np.nan)
    begins[:number] = lines.first(are_unsafe, parts)
    groups = find_minimal_causes(evaluator, lines.at(begins[:number]), unsafe)
    fewer = [
        [(cause, share) for cause in group if len(cause.changes) < size]
        for group, share, size in zip(groups, begins.tolist(), sizes.tolist(), strict=False)
    ]
    is_later = np.array([bool(group) for group in fewer], dtype=bool)
    begins[:number][is_later] = np.nan
    if is_later.any() and evaluator.left is None:
        begins[:number][is_later] = lines.some(is_later).first(are_causes, parts)

    # Where it is safe again, and the values where it begins.
    again = lines.safe_again(begins[:number], evaluator, unsafe)
    at_begins = lines.at(begins[:number])
    beginnings = []
    for row, (cause, _) in enumerate(placed):
        boundary = cause.changes
        if row < number and not np.isnan(begins[row]):
            named = members.named(at_begins[row])
            boundary = {name: float(f"{named[name]:.{VALUE_DIGITS}g}") for name in cause.changes}
        gap = float(again[row]) if row < number else np.inf
        beginnings.append(Beginning(cause, float(begins[row]), boundary, gap))
    return beginnings, [one for group in fewer for one in group]


class _Lines(NamedTuple):
    """K lines from the original to the ends of the domain, shape (K, n), and the share of each at
    which it is known to be unsafe, shape (K,).
    """

    starts: FloatArray
    ends: FloatArray
    last: FloatArray

    def at(self, shares: FloatArray) -> FloatArray:
        """The settings at a share of each line, shape (K, n)."""
        return on_lines(self.starts, self.ends, shares[:, np.newaxis])[:, 0]

    def some(self, rows: BoolArray) -> _Lines:
        """Some of the lines."""
        return _Lines(*(values[rows] for values in self))

    def first(
        self, are_unsafe: Callable[[FloatArray], BoolArray], parts: Sequence[int]
    ) -> FloatArray:
        """The first unsafe share of each line, with as few decimals as it needs to be unsafe."""
        unsafe_ends = self.at(self.last)
        exact = find_boundaries(self.starts, unsafe_ends, are_unsafe, parts).unsafe_shares
        shares = self.last.copy()
        is_open = np.ones(len(shares), dtype=bool)
        for decimals in DECIMALS:
            # What is a rounding error of the scaled share is none of the share.
            scaled = np.round(exact * self.last * 10**decimals, 6)
            rounded = np.minimum(np.ceil(scaled) / 10**decimals, self.last)
            is_unsafe = are_unsafe(self.at(rounded))
            shares = np.where(is_open & is_unsafe, rounded, shares)
            is_open = is_open & ~is_unsafe
        return shares

    def safe_again(self, begins: FloatArray, evaluator: Evaluator, unsafe: Unsafe) -> FloatArray:
        """The first of `PLACES` equally distant shares of each line that is beyond its beginning
        and safe; infinite if there is none.
        """
        grid = np.tile(np.arange(1, PLACES + 1) / PLACES, (len(begins), 1))
        settings = on_lines(self.starts, self.ends, grid).reshape(-1, self.starts.shape[1])
        runs = evaluator.evaluate(settings, BOUNDARIES)
        is_safe = (runs.valid & ~unsafe.of(runs)).reshape(grid.shape)
        is_again = is_safe & (grid > begins[:, np.newaxis])
        return np.asarray(np.where(is_again, grid, np.inf).min(axis=1))
