"""The share of the way to the ends of the domain at which changes begin to be a cause."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import on_lines
from safevar_sumo.questions.causes import (
    BOUNDARIES,
    Cause,
    directions,
    find_minimal_causes,
    settings_of,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.combinations import Enumeration
from safevar_sumo.records import FloatArray, NamedValues
from safevar_sumo.vehicles import CharacteristicSet

STEPS, COARSE_STEPS = 100, 20
"""Parts of the way to the ends, and where few simulations are allowed."""


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
        The smallest larger share at which these changes are safe; NaN if none was found.
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
    pending, *others = (
        [(cause, step.share) for cause in step.causes] for step in steps
    )
    known = [cause for cause, _ in pending]
    pending += _smallest(
        members, known, [placed for nearer in others for placed in nearer]
    )
    beginnings = list[Beginning]()
    while pending:
        begun, smaller = _begin(evaluator, unsafe, pending)
        beginnings += begun
        pending = _smallest(members, [one.cause for one in beginnings], smaller)
    return beginnings


def _smallest(
    members: CharacteristicSet,
    known: Sequence[Cause],
    others: Sequence[tuple[Cause, float]],
) -> list[tuple[Cause, float]]:
    """Those of other causes that contain no known one, nor a smaller one of them."""
    kinds = [{*directions(members, cause.changes)} for cause in known]
    smallest = list[tuple[Cause, float]]()
    for placed in sorted(others, key=lambda placed: len(placed[0].changes)):
        kind = {*directions(members, placed[0].changes)}
        if not any(one <= kind for one in kinds):
            kinds.append(kind)
            smallest.append(placed)
    return smallest


def _begin(
    evaluator: Evaluator, unsafe: Unsafe, placed: Sequence[tuple[Cause, float]]
) -> tuple[list[Beginning], list[tuple[Cause, float]]]:
    """Where causes begin, and smaller causes that are unsafe there."""
    # Of few simulations half are left for the neighbours and the other parameter sets.
    is_free = evaluator.left is None
    steps = STEPS if is_free else COARSE_STEPS
    prices = np.cumsum([steps + 2 ** len(cause.changes) for cause, _ in placed])
    number = int(np.count_nonzero(prices <= evaluator.at_most(int(prices[-1]), 2)))
    beginnings = [
        Beginning(cause, share if share < 1 else np.nan, cause.changes, np.nan)
        for cause, share in placed
    ]
    if not number:
        return beginnings, []

    # Lines from the original to the ends of the domain, shape (K, steps, n).
    members = evaluator.characteristics
    values = settings_of(members, [cause for cause, _ in placed[:number]])
    starts = members.with_original_vehicle(values)
    ends = np.select(
        [values > starts, values < starts], [members.upper, members.lower], starts
    )
    shares = np.arange(1, steps + 1) / steps
    settings = on_lines(starts, ends, np.tile(shares, (number, 1)))
    runs = evaluator.evaluate(settings.reshape(-1, len(members)), BOUNDARIES)
    is_unsafe = unsafe.of(runs).reshape(settings.shape[:2])
    is_safe = runs.valid.reshape(is_unsafe.shape) & ~is_unsafe

    def smaller_causes(settings: FloatArray) -> list[list[Cause]]:
        """The causes with fewer changes of each of several unsafe settings."""
        groups = find_minimal_causes(evaluator, settings, unsafe)
        whole = members.number_changed(settings).tolist()
        return [
            [cause for cause in group if len(cause.changes) < size]
            for group, size in zip(groups, whole, strict=True)
        ]

    # Where each is unsafe first. If fewer of its changes are unsafe there, it is a cause later.
    first = is_unsafe.argmax(axis=1)
    groups = smaller_causes(settings[range(number), first])
    smaller = list[tuple[Cause, float]]()
    for row, (group, at) in enumerate(zip(groups, first.tolist(), strict=True)):
        smaller += [(cause, float(shares[at])) for cause in group]
        if group and not is_free:
            continue
        if group:
            (unsafe_at,) = np.nonzero(is_unsafe[row])
            are_causes = [
                not fewer for fewer in smaller_causes(settings[row, unsafe_at])
            ]
            at = unsafe_at[are_causes][0]

        # The values there, and where it is safe again.
        cause = placed[row][0]
        named = members.named(settings[row, at])
        # What is a rounding error of the share is none of the value.
        boundary = {name: float(f"{named[name]:.12g}") for name in cause.changes}
        again = shares[at + 1 :][is_safe[row, at + 1 :]]
        beginnings[row] = Beginning(
            cause, float(shares[at]), boundary, min(again, default=np.nan)
        )
    return beginnings, smaller
