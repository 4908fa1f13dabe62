"""How far each value of a vehicle may go alone, all others as in the original.

Nothing here knows of studies: a star is a space of vehicles that differ from its center in one
value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.cases import CaseJudge, CaseSearch, Space
from safevar_sumo.records import FloatArray

MOST_SEARCHES = 20
"""Largest number of searches that move limits alone; values that the last one moves stay as in the
original.
"""
Side = tuple[int, int]
"""0, below the original, or 1, above it; and the column of a value."""


class Alone(NamedTuple):
    """The last safe values below and above the original, each of shape (n,); and by side a case
    just beyond.
    """

    lower: FloatArray
    upper: FloatArray
    beyond: Mapping[Side, FloatArray] = {}

    def without(self, cases: FloatArray, center: FloatArray) -> Alone:
        """Limits that leave no room on the sides where some cases are."""
        lower, upper = self.lower.copy(), self.upper.copy()
        vehicles = cases[:, : len(center)]
        is_below = (vehicles < center).any(axis=0)
        is_above = (vehicles > center).any(axis=0)
        lower[is_below] = center[is_below]
        upper[is_above] = center[is_above]
        return self._replace(lower=lower, upper=upper)


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
    starts = np.hstack([np.tile(center, (len(encounters), 1)), encounters])
    lines = []
    for column in range(star.size):
        for end in (limits.lower, limits.upper):
            if end[column] != center[column]:
                line = starts.copy()
                line[:, column] = end[column]
                lines.append(line)
    if not lines:
        return limits
    last = np.concatenate(lines)
    first = np.tile(starts, (len(lines), 1))
    shares = np.arange(1, values + 1)[:, np.newaxis, np.newaxis] / values
    on_lines = first + shares * (last - first)
    on_lines[-1] = last
    robustness = judge(on_lines.reshape(-1, last.shape[1]))
    is_unsafe = robustness.reshape(on_lines.shape[:2]) < 0

    # The first unsafe value of each line; the one before it is safe.
    fails = np.flatnonzero(is_unsafe.any(axis=0))
    number = np.argmax(is_unsafe, axis=0)[fails]
    unsafe = on_lines[number, fails]
    return limits_before(judge, star, limits, unsafe, parts, number / (number + 1))


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
        starts, unsafe, lambda cases: judge(cases) < 0, parts, lowest
    )
    lower, upper, beyond = limits.lower.copy(), limits.upper.copy(), {**limits.beyond}
    for safe, failure in zip(lines.safe, lines.unsafe, strict=True):
        (column,) = np.flatnonzero(failure[: star.size] != center).tolist()
        value = safe[column]
        is_above = failure[column] > center[column]
        end = upper if is_above else lower
        if value < end[column] if is_above else value > end[column]:
            end[column] = value
            beyond[int(is_above), column] = failure
    return Alone(lower, upper, beyond)


def search_alone(
    judge: CaseJudge,
    star: Space,
    limits: Alone,
    search: CaseSearch,
    parts: Sequence[int],
) -> Alone:
    """Limits of a star in which a search finds nothing, within known ones."""
    unsafe = star.lower[np.newaxis][:0]
    for _ in range(MOST_SEARCHES):
        unsafe = search(star.of_vehicles(limits.lower, limits.upper), unsafe[:0]).unsafe
        if not len(unsafe):
            return limits
        limits = limits_before(judge, star, limits, unsafe, parts)
    return limits.without(unsafe, _center_of(star))


def _center_of(star: Space) -> FloatArray:
    assert star.center is not None
    return star.center
