"""Finds where causes begin: the smallest share of the way from the original to the ends of the
domain at which the changes are a cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.boundary import on_lines
from safevar_sumo.questions.cause_limits import (
    PARTS,
    find_cause_limits,
    settings_of_line,
)
from safevar_sumo.questions.causes import (
    BOUNDARIES,
    Cause,
    Causes,
    directions,
    find_minimal_causes,
    settings_of,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.combinations import Enumeration
from safevar_sumo.records import FloatArray, NamedValues
from safevar_sumo.vehicles import CharacteristicSet

PlacedCause = tuple[Cause, float]
"""A cause, and the share of the way to the ends at which its values are."""
STEPS, COARSE_STEPS = 100, 20
"""Number of equal parts of the way to the ends, usually and with few simulations."""


class Beginning(NamedTuple):
    """Where a cause begins.

    Attributes
    ----------
    cause
        The cause, with its values at the ends of the domain or, if these are safe, nearer to the
        original. The checks of similar vehicles and of other parameter sets use these values.
    begins_at
        The smallest share of the way to the ends at which it was found to be a cause; NaN if the
        changes are at different shares, or if smaller changes were not simulated.
    boundary
        The smallest values of the changes that were found to be a cause.
    safe_again
        The smallest share above it at which these changes are safe again; NaN if there is none.
    """

    cause: Cause
    begins_at: float
    boundary: NamedValues
    safe_again: float


def find_beginnings(
    evaluator: Evaluator, unsafe: Unsafe, steps: Sequence[Enumeration]
) -> list[Beginning]:
    """Find where causes begin.

    The causes are those of the enumerations `steps`, of which the first is at the ends of the
    domain. Smaller causes that are found on the way are added. A cause that contains another cause
    is left out, unless both are minimal at the ends.
    """
    members = evaluator.characteristics
    placed = [(cause, step.share) for step in steps for cause in step.causes]
    at_ends = steps[0].causes
    pending = placed[: len(at_ends)]
    pending += _smallest(members, at_ends, placed[len(at_ends) :])
    beginnings = []
    while pending:
        new_beginnings, smaller = _begin(evaluator, unsafe, pending)
        beginnings += new_beginnings
        causes = [beginning.cause for beginning in beginnings]
        pending = _smallest(members, causes, smaller)
    return beginnings


def with_sample(
    evaluator: Evaluator, unsafe: Unsafe, known: Sequence[Beginning], sampled: Causes
) -> list[Beginning]:
    """The known beginnings, and those of causes of sampled vehicles that have fewer changes, or as
    many changes as the smallest known cause. Of causes with the same changes in the same
    directions, the one that begins nearest to the original counts.
    """
    members = evaluator.characteristics
    beginnings = {
        directions(members, beginning.cause.changes): beginning for beginning in known
    }
    sampled = [cause for cause in sampled if cause.changes]
    causes = [*(beginning.cause for beginning in known), *sampled]
    fewest = min((len(cause.changes) for cause in causes), default=0)

    def share_of(cause: Cause) -> float:
        """The share of the way to the ends within which all changes of a cause lie."""
        return max(shares_of_way(members, cause.changes))

    nearest = dict[tuple[str, ...], Cause]()
    for cause in sorted(sampled, key=share_of):
        kind = directions(members, cause.changes)
        begins_at = np.inf
        if kind in beginnings:
            # Without a share, the known cause is at the ends.
            begins_at = np.nan_to_num(beginnings[kind].begins_at, nan=1.0)
        if len(cause.changes) == fewest and share_of(cause) + 1 / STEPS < begins_at:
            nearest.setdefault(kind, cause)

    # Each cause has a line for all its changes, and one for each change.
    price = (1 + fewest) * (settings_of_line(PARTS) + STEPS)
    number = evaluator.of_stage(price * len(nearest), 4) // price
    chosen = list(nearest.values())[:number]
    limits = find_cause_limits(evaluator, chosen, unsafe)
    for cause, limit in zip(chosen, limits, strict=True):
        kind = directions(members, cause.changes)
        begins_at = safe_again = np.nan
        if fewest == 1:
            (begins_at,) = shares_of_way(members, limit.boundary)
            if not evaluator.has_repeats:
                safe_again = _first_safe_share(evaluator, unsafe, cause, begins_at)
        # The checks keep the values of a known cause, which are farther in the unsafe range.
        checked = beginnings[kind].cause if kind in beginnings else cause
        beginnings[kind] = Beginning(checked, begins_at, limit.boundary, safe_again)
    return list(beginnings.values())


def shares_of_way(members: CharacteristicSet, changes: NamedValues) -> list[float]:
    """For each change, the share of the way from the original value to the end of the domain."""
    shares = []
    for item in members:
        if item.name in changes:
            change = changes[item.name] - item.original
            end = item.upper if change > 0 else item.lower
            shares.append(change / (end - item.original))
    return shares


def _first_safe_share(
    evaluator: Evaluator, unsafe: Unsafe, cause: Cause, begins_at: float
) -> float:
    """The smallest of `STEPS` shares of the way to the ends above `begins_at` at which the changes
    of a cause are safe; NaN if there is none.
    """
    members = evaluator.characteristics
    shares = np.arange(1, STEPS + 1) / STEPS
    shares = shares[shares > begins_at]
    (settings,) = _on_way_to_ends(members, [cause], shares)
    runs = evaluator.evaluate(settings, BOUNDARIES)
    is_safe = runs.valid & ~unsafe.of(runs)
    return float(min(shares[is_safe], default=np.nan))


def _on_way_to_ends(
    members: CharacteristicSet, causes: Causes, shares: FloatArray
) -> FloatArray:
    """The settings in which the changes of each of K causes are at P shares of the way from the
    original vehicle to the ends of their domains, shape (K, P, n).
    """
    settings = settings_of(members, causes)
    starts = members.with_original_vehicle(settings)
    ends = np.select(
        [settings > starts, settings < starts], [members.upper, members.lower], starts
    )
    return on_lines(starts, ends, shares[np.newaxis])


def _smallest(
    members: CharacteristicSet,
    references: Causes,
    candidates: Sequence[PlacedCause],
) -> list[PlacedCause]:
    """The candidates that contain neither a cause of `references` nor a smaller candidate. A cause
    contains another cause if it has all its changes, in the same directions.
    """
    kinds = [{*directions(members, cause.changes)} for cause in references]
    smallest = []
    for placed in sorted(candidates, key=lambda placed: len(placed[0].changes)):
        kind = {*directions(members, placed[0].changes)}
        if not any(smaller_kind <= kind for smaller_kind in kinds):
            kinds.append(kind)
            smallest.append(placed)
    return smallest


def _begin(
    evaluator: Evaluator, unsafe: Unsafe, placed: Sequence[PlacedCause]
) -> tuple[list[Beginning], list[PlacedCause]]:
    """The beginnings of causes, and smaller causes that were found where a cause begins."""
    # With few simulations, half of them are left to check the causes: with similar vehicles and in
    # other parameter sets.
    is_free = not evaluator.budget.is_few
    steps = STEPS if is_free else COARSE_STEPS
    causes = [cause for cause, _ in placed]
    prices = np.cumsum([steps + 2 ** len(cause.changes) for cause in causes])
    number = int(np.count_nonzero(prices <= evaluator.of_stage(int(prices[-1]), 2)))
    beginnings = []
    for cause, share in placed:
        # At the ends, nobody knows where a cause begins.
        begins_at = share if share < 1 else np.nan
        beginnings.append(Beginning(cause, begins_at, cause.changes, np.nan))

    members = evaluator.characteristics
    shares = np.arange(1, steps + 1) / steps
    settings = _on_way_to_ends(members, causes[:number], shares)
    runs = evaluator.evaluate(settings.reshape(-1, len(members)), BOUNDARIES)
    is_unsafe = evaluator.confirmed(runs, unsafe).reshape(settings.shape[:2])
    is_safe = runs.valid.reshape(is_unsafe.shape) & ~is_unsafe
    if evaluator.has_repeats:
        # Some runs that do not fail are no gap in the unsafe range.
        is_safe[:] = False

    def smaller_causes(settings: FloatArray) -> list[list[Cause]]:
        """For each unsafe setting, the causes that have fewer changes than the setting."""
        groups = find_minimal_causes(evaluator, settings, unsafe)
        sizes = members.number_changed(settings).tolist()
        for group, size in zip(groups, sizes, strict=True):
            group[:] = [cause for cause in group if len(cause.changes) < size]
        return groups

    # If only some of a cause's changes are enough at its first unsafe share, the whole cause is not
    # minimal there: it begins at a larger share.
    # If no setting on a line was confirmed as unsafe, its first setting says nothing.
    rows = np.flatnonzero(is_unsafe.any(axis=1))
    first_unsafe = is_unsafe[rows].argmax(axis=1)
    groups = smaller_causes(settings[rows, first_unsafe])
    smaller = []
    for row, first, group in zip(
        rows.tolist(), first_unsafe.tolist(), groups, strict=True
    ):
        at = first
        smaller += [(cause, shares[at]) for cause in group]
        if group and not is_free:
            continue
        if group:
            (unsafe_at,) = np.nonzero(is_unsafe[row])
            subcauses = smaller_causes(settings[row, unsafe_at])
            if [] not in subcauses:
                continue
            at = unsafe_at[subcauses.index([])]
        cause = causes[row]
        named = members.named(settings[row, at])
        # Twelve digits are enough: further digits are rounding errors of the share.
        boundary = {name: float(f"{named[name]:.12g}") for name in cause.changes}
        safe_shares = shares[at + 1 :][is_safe[row, at + 1 :]]
        beginnings[row] = Beginning(
            cause, shares[at], boundary, min(safe_shares, default=np.nan)
        )
    return beginnings, smaller
