"""Minimal causes: the smallest subsets of a setting's changes that are unsafe by themselves.

Outcomes need not be monotone: a change may take back what another one does. So nothing is inferred, every subset of a
size is simulated, all those smaller than the smallest unsafe one included; that none of these is unsafe is what makes
a cause minimal.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.records import FloatArray

CHUNK = 20_000
"""Subsets that are held in memory at the same time."""


class MinimalCause(NamedTuple):
    """A smallest unsafe subset of a setting's changes: the columns that keep their values, and what they do by themselves.

    `setting` has shape (n,); `safety_degree` is in m, or -m/s.
    """

    columns: tuple[int, ...]
    setting: FloatArray
    outcome: str
    safety_degree: float | None


class _Subset(NamedTuple):
    """Which changes of which setting."""

    setting: int
    columns: tuple[int, ...]


def minimal_causes(bench: Bench, settings: FloatArray, unsafe: Unsafe) -> list[list[MinimalCause]]:
    """All smallest unsafe subsets of the changes of every setting, shape (M, n); none where no subset is unsafe.

    The empty subset counts: a study whose original vehicle is unsafe needs no change.
    """
    original = bench.characteristics.original
    changed = [tuple(np.flatnonzero(row).tolist()) for row in bench.characteristics.changed(settings)]
    found: list[list[MinimalCause]] = [[] for _ in settings]
    for size in range(max(map(len, changed), default=0) + 1):
        subsets = [_Subset(setting, columns) for setting, of_it in enumerate(changed) if not found[setting]
                   for columns in combinations(of_it, size)]
        for start in range(0, len(subsets), CHUNK):
            part = subsets[start:start + CHUNK]
            tried = np.tile(original, (len(part), 1))
            for row, (setting, columns) in enumerate(part):
                tried[row, list(columns)] = settings[setting, list(columns)]
            evaluations = bench.evaluate(tried, f"subsets of {size} changes")
            for row in np.flatnonzero(unsafe.of(evaluations)).tolist():
                found[part[row].setting].append(
                    MinimalCause(part[row].columns, tried[row], str(evaluations.outcome[row]), number(evaluations.f_safe[row])))
    return found


def number(value: float) -> float | None:
    """A number as records hold it: what is undefined is None."""
    return None if np.isnan(value) else float(value)


def expected_cost(changes: int) -> int:
    """About how many subsets of so many changes are simulated until the smallest unsafe ones are found.

    As if these had half of the changes, which is about what causes of the shipped studies come to.
    """
    return sum(comb(changes, size) for size in range((changes + 1) // 2 + 1))


def affordable(settings: FloatArray, bench: Bench, limit: int) -> list[int]:
    """Rows of settings whose minimal causes can be found with about `limit` simulations: all, or a random sample of them."""
    costs = [expected_cost(int(changes)) for changes in bench.characteristics.number_changed(settings)]
    if sum(costs) <= limit:
        return list(range(len(settings)))
    order = np.random.default_rng(bench.study.search.seed).permutation(len(settings))
    within = np.cumsum([costs[row] for row in order]) <= limit
    return sorted(order[within].tolist())


def necessary(causes: Sequence[MinimalCause]) -> frozenset[int]:
    """Columns that every one of a setting's minimal causes needs."""
    return frozenset.intersection(*(frozenset(cause.columns) for cause in causes)) if causes else frozenset()


def involved(causes: Sequence[MinimalCause]) -> frozenset[int]:
    """Columns that one of a setting's minimal causes needs."""
    return frozenset(column for cause in causes for column in cause.columns)
