"""The value from which on a cause is unsafe, and how many vehicles around it are."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.causes import BOUNDARIES, Cause, settings_of
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import FloatArray, NamedValues

PARTS = (32, 8, 8, 8)
"""Number of parts into which each round divides what is left of a line from the original to a
setting. The search finds every unsafe stretch of the line that is as long as the first parts.
"""
COARSE_PARTS = (8, 4, 4)
"""The same where few simulations are allowed."""


def settings_of_line(parts: Sequence[int]) -> int:
    """How many settings of a line are simulated."""
    return sum(parts) - len(parts) + 1


class BoundaryState(StrEnum):
    """What lies on a line from the original just below the smallest share of the line that is
    unsafe.
    """

    SAFE = "safe"
    FILTER = "filter threshold"
    NOT_SIMULATED = "not simulated"


class Limits(NamedTuple):
    """How far the changes of a cause shrink while they stay unsafe and above the filter's
    thresholds.

    Attributes
    ----------
    boundary
        The values after all changes are multiplied by `fraction`, the smallest factor at which the
        vehicle is unsafe.
    single_boundary
        For each characteristic, the value to which this one can return towards the original while
        the others stay.
    fraction
        The factor.
    end
        What lies just below the factor.
    """

    boundary: NamedValues
    single_boundary: NamedValues
    fraction: float
    end: BoundaryState


def find_cause_limits(
    evaluator: Evaluator, causes: Sequence[Cause], unsafe: Unsafe
) -> list[Limits]:
    """Find the limits of causes."""
    if not causes:
        return []

    # What each cause changes.
    characteristics = evaluator.characteristics
    settings = settings_of(characteristics, causes)
    original = characteristics.with_original_vehicle(settings)
    is_changed = settings != original
    # A cause has a line on which all its changes are scaled, then a line for each change by itself.
    groups = [
        np.vstack([flags, np.eye(len(flags), dtype=bool)[flags]])
        for flags in is_changed
    ]
    line_counts = list(map(len, groups))
    is_scaled = np.concatenate(groups)
    ends = np.repeat(settings, line_counts, axis=0)
    original = np.repeat(original, line_counts, axis=0)

    # A line begins where what it scales is as in the original.
    starts = np.where(is_scaled, original, ends)
    thresholds = np.divide(
        characteristics.threshold,
        np.abs(ends - original),
        out=np.zeros(ends.shape),
        where=is_scaled,
    )
    number = len(starts) * settings_of_line(PARTS)
    is_coarse = evaluator.left is not None and evaluator.left < 2 * number
    parts = COARSE_PARTS if is_coarse else PARTS
    with evaluator.phases.stage(BOUNDARIES, len(starts) * settings_of_line(parts)):
        shares, limits, states = _first_unsafe_shares(
            evaluator, starts, ends, unsafe, thresholds.max(axis=1), parts
        )

    # The limits of each cause, from its lines.
    first_lines = np.cumsum([0, *line_counts])
    limits_of_causes = []
    for cause, flags, (line, stop) in zip(
        causes, is_changed, pairwise(first_lines), strict=True
    ):
        values = limits[line, flags].tolist()
        single_values = np.diagonal(limits[line + 1 : stop, flags]).tolist()
        limits_of_causes.append(
            Limits(
                boundary=dict(zip(cause.changes, values, strict=True)),
                single_boundary=dict(zip(cause.changes, single_values, strict=True)),
                fraction=float(shares[line]) if cause.changes else 0.0,
                end=states[line],
            )
        )
    return limits_of_causes


def _first_unsafe_shares(
    evaluator: Evaluator,
    starts: FloatArray,
    ends: FloatArray,
    unsafe: Unsafe,
    lowest: FloatArray,
    parts: Sequence[int],
) -> tuple[FloatArray, FloatArray, list[BoundaryState]]:
    """The first unsafe share of each of M lines, shape (M,), the setting there, shape (M, n), and
    what lies just below it.

    A line leads from `starts` to `ends`, shape (M, n); its settings count from the share `lowest`,
    shape (M,), on, and its end must be unsafe. Rounds divide it into `parts`, whose product is
    16,384 by default. A setting that cannot be simulated is neither safe nor unsafe; just below the
    share, it gives the state `NOT_SIMULATED`.
    """
    # The first unsafe share of each line.
    boundaries = find_boundaries(
        starts,
        ends,
        lambda rows: unsafe.of(evaluator.evaluate(rows, BOUNDARIES)),
        parts,
        lowest,
    )

    # What ends the line on the safe side.
    is_valid = evaluator.evaluate(boundaries.safe, BOUNDARIES).valid
    is_at_threshold = (boundaries.safe_shares == lowest) & (lowest > 0)
    states = np.select(
        [is_at_threshold, is_valid | (boundaries.safe_shares == lowest)],
        [BoundaryState.FILTER, BoundaryState.SAFE],
        BoundaryState.NOT_SIMULATED,
    )
    return (
        boundaries.unsafe_shares,
        boundaries.unsafe,
        list(map(BoundaryState, states)),
    )
