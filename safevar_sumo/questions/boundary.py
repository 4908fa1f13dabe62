"""The boundary between safe and unsafe settings on straight lines, and the limits alone: how far
one value of a vehicle may change while all other values are as in the original vehicle.

This module knows nothing of studies. A case is a vehicle (n values), the number of a world, and k
places; see `safevar_sumo.questions.cases`. A star is the space of all cases whose vehicle differs
from the star's center (the original vehicle) in one value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.cases import CaseJudge, CaseSearch, Space
from safevar_sumo.records import BoolArray, FloatArray

PARTS = (8, 8, 8, 8)
"""Each round divides a piece of a line into this number of equal parts. The next round divides one
of these parts.
"""
MOST_SEARCHES = 20
"""Largest number of searches that move limits alone. If the last search still finds an unsafe case,
the value of this case gets no room: its limit is the value of the original.
"""
Side = tuple[int, int]
"""A side of the original: 0 (below it) or 1 (above it), and the column of the vehicle's value."""


class Boundaries(NamedTuple):
    """The boundary on each of K lines.

    Attributes
    ----------
    safe_shares, unsafe_shares
        The last safe and the first unsafe share of the way from the start of the line to its end,
        from 0 to 1, shape (K,).
    safe, unsafe
        The settings at these shares, shape (K, n).
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
    """Find the first unsafe setting on each of K lines.

    The search counts the setting at the share `lowest` as safe, and the end of the line as unsafe;
    it tests neither. The error of a boundary is at most one part of the last round.

    Parameters
    ----------
    starts, ends
        The ends of the lines, shape (K, n).
    are_unsafe
        Says which of M settings of all lines, shape (M, n), are unsafe; shape (M,).
    parts
        The number of parts in each round.
    lowest
        Share of each line at which the search begins, shape (K,) or a number.
    """
    line_count = len(starts)
    lines = np.arange(line_count)
    low = np.full(line_count, lowest, dtype=float)
    high = np.ones(line_count)
    for number in parts:
        # Divide the piece from `low` to `high` of each line: shares of the bounds between the
        # parts, shape (K, number + 1).
        width = (high - low)[:, np.newaxis]
        shares = low[:, np.newaxis] + width * np.arange(number + 1) / number
        # The last bound gets its exact value, without a rounding error.
        shares[:, -1] = high
        bounds = on_lines(starts, ends, shares[:, 1:-1])
        is_unsafe = np.ones((line_count, number), dtype=bool)
        tested = are_unsafe(bounds.reshape(-1, starts.shape[1]))
        is_unsafe[:, :-1] = tested.reshape(line_count, number - 1)
        # The next round divides the part below the first unsafe bound.
        first_unsafe = np.argmax(is_unsafe, axis=1)
        low = shares[lines, first_unsafe]
        high = shares[lines, first_unsafe + 1]
    safe = on_lines(starts, ends, low[:, np.newaxis])[:, 0]
    unsafe = on_lines(starts, ends, high[:, np.newaxis])[:, 0]
    return Boundaries(low, high, safe, unsafe)


def on_lines(starts: FloatArray, ends: FloatArray, shares: FloatArray) -> FloatArray:
    """The settings at P shares of the way on each of K lines, shape (K, P, n). The lines lead from
    `starts` to `ends`, shape (K, n); `shares` has shape (K, P).
    """
    factors = shares[..., np.newaxis]
    start = starts[:, np.newaxis]
    end = ends[:, np.newaxis]
    return np.where(factors >= 1, end, start + factors * (end - start))


class Alone(NamedTuple):
    """The limits of each value alone.

    Attributes
    ----------
    lower, upper
        The last safe value below and above the original, shape (n,).
    breaches
        For a side, an unsafe case just beyond the limit.
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
    """Find limits alone by a scan: evenly spaced values of each line are simulated.

    Parameters
    ----------
    judge
        Returns the robustness of cases; below 0 a case is unsafe.
    star
        The cases whose vehicle differs from the original in one value.
    limits
        Known limits: the new limits are not wider.
    encounters
        The E encounters (world and places) in which the scan drives, shape (E, 1 + k).
    values
        Number of values that the scan tests between the original and each known limit.
    parts
        The parts into which `find_boundaries` divides the way between the last safe and the first
        unsafe value.
    """
    center = _center_of(star)

    # Each line leads from the original to a known limit, in one encounter.
    ends = np.stack([limits.lower, limits.upper], axis=1)
    columns, sides = np.nonzero(ends != center[:, np.newaxis])
    number = len(encounters)
    originals = np.hstack([np.tile(center, (number, 1)), encounters])
    starts = np.tile(originals, (len(columns), 1))
    stops = starts.copy()
    rows = np.arange(len(stops))
    stops[rows, columns.repeat(number)] = ends[columns, sides].repeat(number)

    # Find the first unsafe value of each line. A line is left out if neither its end nor a value
    # before the end fails.
    lines = find_boundaries(
        starts,
        stops,
        lambda cases: judge(cases) < 0,
        [values],
    )
    fails = np.flatnonzero((judge(stops) < 0) | (lines.unsafe_shares < 1))
    # The first unsafe value is step `passed` + 1 of the scan. The line is now shorter, and ends
    # there: step `passed` was safe, at the share passed / (passed + 1) of the shorter line.
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
    """The limits alone, moved so that K unsafe cases lie beyond them.

    Each of the unsafe cases, shape (K, n + 1 + k), has one change from the original. The change is
    reduced, in the same encounter, until the case is safe. The share `lowest` of the change, shape
    (K,), counts as safe.
    """
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
    """Move the known limits of a star inwards, until a search finds no unsafe case within them."""
    start = star.lower[np.newaxis][:0]
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

    # After the last search, a side with an unsafe case gets no room: its limit is the original.
    center = _center_of(star)
    vehicles = unsafe[:, : star.size]
    return limits._replace(
        lower=np.where((vehicles < center).any(axis=0), center, limits.lower),
        upper=np.where((vehicles > center).any(axis=0), center, limits.upper),
    )


def _center_of(star: Space) -> FloatArray:
    assert star.center is not None
    return star.center
