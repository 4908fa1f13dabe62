"""The boundary between what is safe and what is unsafe on straight lines of settings, and how far
each value of a vehicle may go alone, all others as in the original.

Nothing here knows of studies: a star is a space of vehicles that differ from its center in one
value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.cases import CaseJudge, CaseSearch, Space
from safevar_sumo.records import BoolArray, FloatArray

PARTS = (8, 8, 8, 8)
"""Number of equal parts into which each round divides what is left of a line."""
MOST_SEARCHES = 20
"""Largest number of searches that move limits alone; values that the last one moves stay as in the
original.
"""
Side = tuple[int, int]
"""0, below the original, or 1, above it; and the column of a value."""


class Boundaries(NamedTuple):
    """The last safe and the first unsafe share of each of K lines, shape (K,), with the settings
    there, shape (K, n).
    """

    safe_shares: FloatArray
    unsafe_shares: FloatArray
    safe: FloatArray
    unsafe: FloatArray


def find_boundaries(
    starts: FloatArray,
    ends: FloatArray,
    are_unsafe: Callable[[FloatArray], BoolArray],
    parts: Sequence[int] = PARTS,
    lowest: FloatArray | float = 0.0,
) -> Boundaries:
    """The first unsafe place on each of K lines from `starts` to `ends`, shape (K, n), from the
    share `lowest` on, shape (K,).

    The start of a line counts as safe and its end as unsafe, without being tested. `are_unsafe`
    tests settings of all lines together, shape (M, n): which of them are unsafe, shape (M,). The
    error is at most one part of the last round.
    """
    lines = np.arange(len(starts))
    low = np.broadcast_to(np.asarray(lowest, dtype=float), lines.shape)
    high = np.ones(len(lines))
    for number in parts:
        # The bounds between equal parts of what is left of each line.
        width = (high - low)[:, np.newaxis]
        shares = low[:, np.newaxis] + width * np.arange(number + 1) / number
        # Without a rounding error.
        shares[:, -1] = high
        bounds = on_lines(starts, ends, shares[:, 1:-1])
        is_unsafe = np.ones((len(lines), number), dtype=bool)
        tested = are_unsafe(bounds.reshape(-1, starts.shape[1]))
        is_unsafe[:, :-1] = tested.reshape(len(lines), number - 1)
        # Of these parts the one below the first unsafe bound is left.
        first_unsafe = np.argmax(is_unsafe, axis=1)
        low = shares[lines, first_unsafe]
        high = shares[lines, first_unsafe + 1]
    safe = on_lines(starts, ends, low[:, np.newaxis])[:, 0]
    unsafe = on_lines(starts, ends, high[:, np.newaxis])[:, 0]
    return Boundaries(low, high, safe, unsafe)


def on_lines(starts: FloatArray, ends: FloatArray, shares: FloatArray) -> FloatArray:
    """Settings at P `shares`, shape (K, P), of K lines from `starts` to `ends`, shape (K, n); shape
    (K, P, n).
    """
    factors = shares[..., np.newaxis]
    start = starts[:, np.newaxis]
    end = ends[:, np.newaxis]
    return np.where(factors >= 1, end, start + factors * (end - start))


class Alone(NamedTuple):
    """The last safe values below and above the original, each of shape (n,); and by side a case
    just beyond.
    """

    lower: FloatArray
    upper: FloatArray
    breaches: Mapping[Side, FloatArray] = {}


def scan_alone(
    judge: CaseJudge,
    star: Space,
    limits: Alone,
    encounters: FloatArray,
    values: int,
    parts: Sequence[int],
) -> Alone:
    """Limits of a star within known ones, by some values between its center and each of these, in
    some encounters; `parts` as of `find_boundaries`.
    """
    center = _center_of(star)

    # Each line leads from the original to an end, in one encounter.
    ends = np.stack([limits.lower, limits.upper], axis=1)
    columns, sides = np.nonzero(ends != center[:, np.newaxis])
    number = len(encounters)
    originals = np.hstack([np.tile(center, (number, 1)), encounters])
    starts = np.tile(originals, (len(columns), 1))
    stops = starts.copy()
    rows = np.arange(len(stops))
    stops[rows, columns.repeat(number)] = ends[columns, sides].repeat(number)

    # The first unsafe value of each line; the value before it is safe.
    lines = find_boundaries(
        starts,
        stops,
        lambda cases: judge(cases) < 0,
        [values],
    )
    fails = np.flatnonzero((judge(stops) < 0) | (lines.unsafe_shares < 1))
    passed = np.rint(lines.safe_shares[fails] * values)
    lowest = passed / (passed + 1)
    return limits_before(
        judge,
        star,
        limits,
        lines.unsafe[fails],
        parts,
        lowest,
    )


def limits_before(
    judge: CaseJudge,
    star: Space,
    limits: Alone,
    unsafe: FloatArray,
    parts: Sequence[int],
    lowest: FloatArray | float = 0.0,
) -> Alone:
    """Limits before K unsafe cases of a star, each safe up to the share `lowest` of its change."""
    center = _center_of(star)
    starts = unsafe.copy()
    starts[:, : star.size] = center
    lines = find_boundaries(
        starts,
        unsafe,
        lambda cases: judge(cases) < 0,
        parts,
        lowest,
    )
    ends = np.stack([limits.lower, limits.upper])
    breaches = {**limits.breaches}
    for safe, failure in zip(lines.safe, lines.unsafe, strict=True):
        (column,) = np.flatnonzero(failure[: star.size] != center).tolist()
        side = int(failure[column] > center[column])
        sign = 2 * side - 1
        if sign * safe[column] < sign * ends[side, column]:
            ends[side, column] = safe[column]
            breaches[side, column] = failure
    lower, upper = ends
    return Alone(lower, upper, breaches)


def search_alone(
    judge: CaseJudge,
    star: Space,
    limits: Alone,
    search: CaseSearch,
    parts: Sequence[int],
) -> Alone:
    """Limits of a star in which a search finds nothing, within known ones."""
    start = star.lower[np.newaxis][:0]
    unsafe = start
    for _ in range(MOST_SEARCHES):
        space = star.of_vehicles(limits.lower, limits.upper)
        unsafe = search(space, start).unsafe
        if not len(unsafe):
            return limits
        limits = limits_before(
            judge,
            star,
            limits,
            unsafe,
            parts,
        )

    # No room is left on the sides where unsafe cases are.
    center = _center_of(star)
    vehicles = unsafe[:, : star.size]
    return limits._replace(
        lower=np.where((vehicles < center).any(axis=0), center, limits.lower),
        upper=np.where((vehicles > center).any(axis=0), center, limits.upper),
    )


def _center_of(star: Space) -> FloatArray:
    assert star.center is not None
    return star.center
