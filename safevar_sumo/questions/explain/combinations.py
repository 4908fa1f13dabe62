"""Finds the smallest unsafe changes by enumeration. A combination sets some characteristics to an
end of their domains, and leaves all others as in the original vehicle. Combinations are simulated
by size; combinations that contain a smaller cause are left out.

Nothing is inferred from other combinations, because a further change may make a vehicle safe again.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, combinations, compress, product, takewhile
from math import comb
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.causes import Cause
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import CharacteristicSet

COMBINATIONS = "try combinations of changes"
"""The phase of progress in which combinations are simulated."""
SHARES = tuple(percent / 100 for percent in range(100, 0, -10))
"""Shares of the way from the original to the ends of the domain at which the fewest unsafe changes
are searched.
"""
MAX_COMBINATIONS = 200_000
"""A size with more combinations is left out: the combinations of a size must be put in order, so
that those that are likely to be unsafe are simulated first.
"""

Change = tuple[int, float]
"""A change of a characteristic: its column in a setting, and its new value."""
Combination = frozenset[Change]
Combinations = list[Combination]


CountBySize = dict[int, int]
"""Numbers of combinations, by the number of their changes."""


class Enumeration(NamedTuple):
    """The result of an enumeration: the causes, which are unsafe combinations of changes without a
    smaller unsafe combination in them.

    Attributes
    ----------
    share
        The share of the way from the original to the end of the domain at which each change is.
    causes
        The causes, the smallest first.
    simulated
        By size, the number of combinations that were simulated, without vehicles that never moved.
    existing
        By size, the number of combinations that contain no smaller cause and violate no constraint.
    containing
        By size, the combinations that contain a smaller cause and violate no constraint.
    is_cut
        Whether combinations were left out because they are too many.
    standing
        The number of combinations that were simulated, but whose vehicle never moved.
    """

    share: float
    causes: list[Cause]
    simulated: CountBySize
    existing: CountBySize
    containing: dict[int, Combinations]
    is_cut: bool
    standing: int

    @property
    def tried(self) -> int:
        """The number of combinations that were simulated."""
        return sum(self.simulated.values())

    @property
    def complete_up_to(self) -> int:
        """The largest size up to which all combinations were simulated."""
        sizes = range(1, len(self.existing) + 1)
        complete_sizes = takewhile(
            lambda size: self.simulated[size] == self.existing[size], sizes
        )
        return len(list(complete_sizes))

    @property
    def size(self) -> int:
        """The least number of changes in a cause; 0 if no cause was found."""
        return len(self.causes[0].changes) if self.causes else 0

    @property
    def fewest(self) -> list[Cause]:
        """The causes with the fewest changes."""
        return [cause for cause in self.causes if len(cause.changes) == self.size]


def enumerate_causes(
    evaluator: Evaluator,
    unsafe: Unsafe,
    limit: int,
    share: float = 1.0,
    *,
    only_fewest: bool = False,
) -> Enumeration:
    """Find all causes whose changes are at a `share` of the way to the ends of their domains, with
    at most `limit` simulated settings.

    If the simulations do not suffice for the last size, the combinations are simulated first whose
    single changes are worst in sum. With `only_fewest`, the first size with a cause is the last
    size, and a size is simulated completely or not at all.

    If encounters are ranges, a combination is simulated in the original encounter and in the
    critical ones (`Evaluator.evaluate_over_encounters`).
    """
    # `room` is the number of combinations that may still be simulated, in all their encounters.
    members = evaluator.characteristics
    changes = _changes(members, share)
    columns = {column for column, _ in changes}
    room = limit // (1 + len(evaluator.critical_encounters))
    # The robustness of the vehicle with each single change. It orders larger combinations.
    effects = dict.fromkeys(changes, np.inf)
    causes = list[Cause]()
    simulated = {}
    existing = {}
    containing = {}
    unsafe_ones = Combinations()
    is_cut = False
    standing = 0

    for size in range(1, len(columns) + 1):
        # Stop at a size with too many combinations to put in order.
        if only_fewest and causes:
            break
        is_cut = comb(len(columns), size) * 2**size > MAX_COMBINATIONS
        if is_cut:
            break
        of_size = list(_of_size(changes, size))
        is_feasible = evaluator.region.feasible(_settings(members, of_size)).tolist()
        candidates = Combinations()
        larger = Combinations()
        for combination in compress(of_size, is_feasible):
            group = candidates
            if any(smaller <= combination for smaller in unsafe_ones):
                group = larger
            group.append(combination)
        is_cut = len(candidates) > room
        if is_cut and (only_fewest or not room):
            break

        # The combinations whose single changes are worst in sum come first.
        candidates.sort(
            key=lambda combination: sum(effects[change] for change in combination)
        )
        chosen = candidates[:room]
        room -= len(chosen)
        containing[size] = larger
        robustness, as_causes, never_moved = _robustness(evaluator, unsafe, chosen)
        existing[size] = len(candidates)
        simulated[size] = len(chosen) - never_moved
        standing += never_moved
        if size == 1:
            single_changes = chain.from_iterable(chosen)
            effects |= zip(single_changes, robustness, strict=True)
        for index in np.flatnonzero(robustness < 0).tolist():
            causes.append(as_causes[index])
            unsafe_ones.append(chosen[index])
        if is_cut:
            break
    return Enumeration(share, causes, simulated, existing, containing, is_cut, standing)


def count_cures(
    evaluator: Evaluator, unsafe: Unsafe, enumeration: Enumeration, limit: int
) -> CountBySize:
    """By size, the number of combinations that contain a smaller cause, but are safe. Only sizes
    are simulated that can be simulated completely, with at most `limit` settings altogether.
    """
    cures = {}
    room = limit // (1 + len(evaluator.critical_encounters))
    for size, containing in enumeration.containing.items():
        room -= len(containing)
        if room < 0:
            break
        settings = _settings(evaluator.characteristics, containing)
        runs = evaluator.evaluate_over_encounters(settings, unsafe, COMBINATIONS)
        cures[size] = int(np.count_nonzero(runs.valid & ~unsafe.of(runs)))
    return cures


def staircase(
    evaluator: Evaluator, unsafe: Unsafe, at_ends: Enumeration, limit: int
) -> list[Enumeration]:
    """Find the fewest unsafe changes at each of `SHARES` of the way to the ends, with at most
    `limit` simulated settings. The first step is `at_ends`, the enumeration at the ends themselves.

    Nearer to the original, more changes may be necessary. Each share leaves enough simulations for
    all shares after it: at least as many as the sizes took at the ends that are smaller than a
    cause.
    """
    steps = [at_ends]
    encounters = 1 + len(evaluator.critical_encounters)
    least_price = encounters * sum(
        number for size, number in at_ends.simulated.items() if size < at_ends.size
    )
    for place, share in enumerate(SHARES[1:], 2):
        remaining_shares = len(SHARES) - place
        budget = (
            limit - remaining_shares * least_price
            if at_ends.causes
            else limit // (remaining_shares + 1)
        )
        step = enumerate_causes(evaluator, unsafe, budget, share, only_fewest=True)
        if not step.tried:
            break
        limit -= (step.tried + step.standing) * encounters
        steps.append(step)
    return steps


def _changes(members: CharacteristicSet, share: float) -> list[Change]:
    """All single changes: each characteristic at a `share` of the way to each end of its domain. An
    end that is the original value is no change.
    """
    changes = []
    for column, item in enumerate(members.vehicle):
        for end in (item.lower, item.upper):
            value = end
            if share < 1:
                value = item.original + share * (end - item.original)
            if end != item.original:
                changes.append((column, value))
    return changes


def _of_size(changes: list[Change], size: int) -> Iterator[Combination]:
    """All combinations of changes of `size` different characteristics."""
    sides: dict[int, list[Change]] = {}
    for change in changes:
        sides.setdefault(change[0], []).append(change)
    for columns in combinations(sides.values(), size):
        yield from map(frozenset, product(*columns))


def _settings(members: CharacteristicSet, chosen: Combinations) -> FloatArray:
    """The settings of the original vehicle with each of M combinations, shape (M, n)."""
    settings = np.tile(members.original, (len(chosen), 1))
    for setting, combination in zip(settings, chosen, strict=True):
        for column, value in combination:
            setting[column] = value
    return settings


def _robustness(
    evaluator: Evaluator, unsafe: Unsafe, chosen: Combinations
) -> tuple[FloatArray, list[Cause], int]:
    """The robustness of each of M combinations (below 0: unsafe), shape (M,), infinite without a
    valid simulation; each combination as a cause, in its worst encounter; and the number of
    combinations whose vehicle never moved.
    """
    members = evaluator.characteristics
    names = members.names
    runs = evaluator.evaluate_over_encounters(
        _settings(members, chosen), unsafe, COMBINATIONS
    )
    causes = []
    unsafe_runs = unsafe.runs(runs).mean(axis=0)
    facts = zip(runs.outcome, runs.f_safe, runs.settings, unsafe_runs, strict=True)
    for combination, (outcome, degree, setting, of_runs) in zip(
        chosen, facts, strict=True
    ):
        changes = {names[column]: value for column, value in sorted(combination)}
        encounter = members.encounter_of(setting)
        causes.append(
            Cause(changes, str(outcome), float(degree), encounter, float(of_runs))
        )
    robustness = np.where(runs.valid, unsafe.robustness(runs), np.inf)
    is_confirmed = evaluator.confirmed(runs, unsafe)
    robustness[(robustness < 0) & ~is_confirmed] = 0.0
    return robustness, causes, int(np.count_nonzero(runs.standing))
