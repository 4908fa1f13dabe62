"""The boundary between what is safe and what is unsafe on straight lines of settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray

PARTS = (8, 8, 8, 8)
"""Number of equal parts into which each round divides what is left of a line."""


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
        shares = (
            low[:, np.newaxis]
            + (high - low)[:, np.newaxis] * np.arange(number + 1) / number
        )
        shares[:, -1] = high  # without a rounding error
        bounds = on_lines(starts, ends, shares[:, 1:-1])
        tested = are_unsafe(bounds.reshape(-1, starts.shape[1])).reshape(
            len(lines), number - 1
        )
        # Of these parts the one below the first unsafe bound is left.
        is_unsafe = np.column_stack([tested, np.ones(len(lines), dtype=bool)])
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
