"""Finds the limits of causes: how far the changes of a cause can shrink while the vehicle stays
unsafe.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.causes import BOUNDARIES, Causes, settings_of
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import FloatArray, NamedValues

PARTS = (32, 8, 8, 8)
"""For each round of the search, the number of parts into which the rest of a line is divided. The
line leads from the original to a setting. The search finds every unsafe stretch of the line that is
as long as a part of the first round.
"""
COARSE_PARTS = (8, 4, 4)
"""The numbers of parts if few simulations are allowed."""


def settings_of_line(parts: Sequence[int]) -> int:
    """The number of settings of a line that are simulated."""
    return sum(parts) - len(parts) + 1


class BoundaryState(StrEnum):
    """The kind of setting just below the smallest unsafe share of a line: a safe setting, the
    smallest change that the filter keeps, or a setting that could not be simulated.
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
        For each characteristic, the value to which it can return towards the original, while all
        other changes stay, and the vehicle stays unsafe.
    fraction
        The factor of `boundary`; 0 for a cause without changes.
    end
        The kind of setting just below this factor.
    """

    boundary: NamedValues
    single_boundary: NamedValues
    fraction: float
    end: BoundaryState


def find_cause_limits(
    evaluator: Evaluator, causes: Causes, unsafe: Unsafe
) -> list[Limits]:
    """Find the limits of each cause, in the order of the causes."""
    if not causes:
        return []
    characteristics = evaluator.characteristics
    settings = settings_of(characteristics, causes)
    original = characteristics.with_original_vehicle(settings)
    is_changed = settings != original
    # A cause has several lines: first a line on which all its changes are scaled, then, for each
    # change, a line on which only this change is scaled.
    groups = [np.vstack([flags, np.diag(flags)[flags]]) for flags in is_changed]
    line_counts = list(map(len, groups))
    is_scaled = np.concatenate(groups)
    ends = np.repeat(settings, line_counts, axis=0)
    original = np.repeat(original, line_counts, axis=0)

    # At the start of a line, the scaled changes are undone. Below the threshold, the filter would
    # undo a change.
    starts = np.where(is_scaled, original, ends)
    thresholds = np.divide(
        characteristics.threshold,
        np.abs(ends - original),
        out=np.zeros(ends.shape),
        where=is_scaled,
    )
    number = len(starts) * settings_of_line(PARTS)
    is_coarse = (
        evaluator.settings_left is not None and evaluator.settings_left < 2 * number
    )
    parts = COARSE_PARTS if is_coarse else PARTS
    with evaluator.phases.stage(BOUNDARIES, len(starts) * settings_of_line(parts)):
        shares, limits, states = _first_unsafe_shares(
            evaluator, starts, ends, unsafe, thresholds.max(axis=1), parts
        )

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
    """The first unsafe share of each of M lines, shape (M,), the setting at this share, shape (M,
    n), and the kind of setting just below it.

    A line leads from `starts` to `ends`, shape (M, n). Only shares from `lowest`, shape (M,), on
    are searched. The end of a line must be unsafe. The search divides a line in rounds (`parts`). A
    setting that cannot be simulated is neither safe nor unsafe. Just below the share, it gives the
    state `NOT_SIMULATED`.
    """
    boundaries = find_boundaries(
        starts,
        ends,
        lambda rows: evaluator.confirmed(evaluator.evaluate(rows, BOUNDARIES), unsafe),
        parts,
        lowest,
    )

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
