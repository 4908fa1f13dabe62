"""The smallest changes that are unsafe, by enumeration: each characteristic is as in the original
vehicle or at an end of its domain, and combinations are simulated by size, without those that
contain a smaller cause.

Nothing is inferred from other combinations, as a further change may make a vehicle safe again.
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
"""The stage of progress."""
SHARES = tuple(percent / 100 for percent in range(100, 0, -10))
"""Shares of the way to the ends of the domain at which the fewest changes are sought."""
MAX_COMBINATIONS = 200_000
"""Largest number of combinations of a size that is begun, as the likely ones come first."""

Change = tuple[int, float]
"""A column, and its value."""
Combination = frozenset[Change]


class Enumeration(NamedTuple):
    """The combinations of changes that are unsafe while all smaller ones within them are safe.

    Attributes
    ----------
    share
        The share of the way to the end of the domain at which each change is.
    causes
        The unsafe combinations, the smallest first.
    simulated, existing
        How many combinations of each size were simulated, and how many there are that contain no
        smaller cause and violate no constraint.
    containing
        The combinations of each size that contain a smaller cause and violate no constraint.
    is_cut
        Whether a larger size was left out, or cut, because it is too large.
    """

    share: float
    causes: list[Cause]
    simulated: dict[int, int]
    existing: dict[int, int]
    containing: dict[int, list[Combination]]
    is_cut: bool

    @property
    def tried(self) -> int:
        return sum(self.simulated.values())

    @property
    def complete_up_to(self) -> int:
        """The largest size up to which all combinations were simulated."""
        sizes = range(1, len(self.existing) + 1)
        complete_sizes = takewhile(
            lambda size: self.simulated[size] == self.existing[size], sizes
        )
        return len([*complete_sizes])

    @property
    def size(self) -> int:
        """The fewest changes that are unsafe; 0 if none was found."""
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
    """All causes of changes at a `share` of the way to the ends of their domains, with at most
    `limit` simulated settings. The last size may be begun only, with the combinations whose single
    changes add up to the worst; with `only_fewest` the first size with a cause is the last, and a
    size is simulated as a whole or not at all.

    Where encounters are ranges a combination is simulated in the original encounter and
    in the critical ones, as `Evaluator.evaluate_over_encounters` says.
    """
    # The changes, and what one combination costs.
    members = evaluator.characteristics
    changes = _changes(members, share)
    columns = {column for column, _ in changes}
    room = limit // (1 + len(evaluator.critical_encounters))
    # What each change leaves by itself.
    effects = dict.fromkeys(changes, np.inf)
    causes = list[Cause]()
    simulated, existing = dict[int, int](), dict[int, int]()
    containing = dict[int, list[Combination]]()
    unsafe_ones = list[Combination]()
    is_cut = False

    for size in range(1, len(columns) + 1):
        # A size is begun while all its combinations can be put in order.
        if only_fewest and causes:
            break
        is_cut = comb(len(columns), size) * 2**size > MAX_COMBINATIONS
        if is_cut:
            break
        of_size = [*_of_size(changes, size)]
        is_feasible = evaluator.region.feasible(_settings(members, of_size)).tolist()
        candidates = list[Combination]()
        larger = list[Combination]()
        for combination in compress(of_size, is_feasible):
            group = candidates
            if any(smaller <= combination for smaller in unsafe_ones):
                group = larger
            group.append(combination)
        is_cut = len(candidates) > room
        if is_cut and (only_fewest or not room):
            break

        # Those whose single changes are worst come first.
        candidates.sort(
            key=lambda combination: sum(effects[change] for change in combination)
        )
        chosen = candidates[:room]
        room -= len(chosen)
        existing[size] = len(candidates)
        simulated[size] = len(chosen)
        containing[size] = larger
        robustness, as_causes = _robustness(evaluator, unsafe, chosen)
        if size == 1:
            single_changes = chain.from_iterable(chosen)
            effects |= zip(single_changes, robustness, strict=True)
        for index in np.flatnonzero(robustness < 0).tolist():
            causes.append(as_causes[index])
            unsafe_ones.append(chosen[index])
        if is_cut:
            break
    return Enumeration(share, causes, simulated, existing, containing, is_cut)


def count_cures(
    evaluator: Evaluator, unsafe: Unsafe, enumeration: Enumeration, limit: int
) -> dict[int, int]:
    """How many of the combinations that contain a smaller cause are safe, by their size; only of
    the sizes that are simulated as a whole with at most `limit` settings.
    """
    cures = dict[int, int]()
    room = limit // (1 + len(evaluator.critical_encounters))
    for size, containing in enumeration.containing.items():
        room -= len(containing)
        if room < 0:
            break
        if not containing:
            continue
        settings = _settings(evaluator.characteristics, containing)
        runs = evaluator.evaluate_over_encounters(settings, unsafe, COMBINATIONS)
        cures[size] = int(np.count_nonzero(runs.valid & ~unsafe.of(runs)))
    return cures


def staircase(
    evaluator: Evaluator, unsafe: Unsafe, at_ends: Enumeration, limit: int
) -> list[Enumeration]:
    """The fewest changes that are unsafe at each of `SHARES` of the way to their ends, with at most
    `limit` simulated settings. At the ends more changes may be necessary than before, so fewer are
    simulated at every share.
    """
    steps = [at_ends]
    encounters = 1 + len(evaluator.critical_encounters)
    least_price = encounters * sum(
        number for size, number in at_ends.simulated.items() if size < at_ends.size
    )
    for remaining_shares, share in zip(
        range(len(SHARES) - 2, -1, -1), SHARES[1:], strict=True
    ):
        budget = (
            limit - remaining_shares * least_price
            if at_ends.causes
            else limit // (remaining_shares + 1)
        )
        step = enumerate_causes(evaluator, unsafe, budget, share, only_fewest=True)
        if not step.tried:
            break
        limit -= step.tried * encounters
        steps.append(step)
    return steps


def _changes(members: CharacteristicSet, share: float) -> list[Change]:
    """The changes of one characteristic."""
    changes = list[Change]()
    for column, item in enumerate(members.vehicle):
        for end in (item.lower, item.upper):
            value = end
            if share < 1:
                value = item.original + share * (end - item.original)
            if end != item.original:
                changes.append((column, value))
    return changes


def _of_size(changes: list[Change], size: int) -> Iterator[Combination]:
    """All combinations of changes of so many different characteristics."""
    sides: dict[int, list[Change]] = {}
    for change in changes:
        sides.setdefault(change[0], []).append(change)
    for columns in combinations(sides.values(), size):
        yield from map(frozenset, product(*columns))


def _settings(members: CharacteristicSet, chosen: list[Combination]) -> FloatArray:
    """The original vehicle with each of M combinations, shape (M, n)."""
    settings = np.tile(members.original, (len(chosen), 1))
    for setting, combination in zip(settings, chosen, strict=True):
        for column, value in combination:
            setting[column] = value
    return settings


def _robustness(
    evaluator: Evaluator, unsafe: Unsafe, chosen: list[Combination]
) -> tuple[FloatArray, list[Cause]]:
    """What each of M combinations leaves to the limit, shape (M,), below 0 where it is unsafe; and
    each as a cause, in its worst encounter.
    """
    members = evaluator.characteristics
    names = members.names
    if not chosen:
        return np.zeros(0), []
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
    return np.where(runs.valid, unsafe.robustness(runs), np.inf), causes
