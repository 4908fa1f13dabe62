"""Minimal causes: the smallest subsets of a setting's changes that are unsafe by themselves.

Outcomes need not be monotone: one change may undo the effect of another. So all subsets of a size are simulated, size by size,
until some are unsafe. These are minimal, as no smaller subset is unsafe.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray, finite_or_none

CHUNK = 20_000
"""Maximum number of subsets in memory at the same time."""


class MinimalCause(NamedTuple):
    """A smallest unsafe subset of a setting's changes: the columns that keep their values, and the outcome.

    `setting` has shape (n,); `safety_degree` is in m, or -m/s.
    """

    columns: tuple[int, ...]
    setting: FloatArray
    outcome: str
    safety_degree: float | None


class _Subset(NamedTuple):
    """A subset of the changes of one setting."""

    setting: int
    columns: tuple[int, ...]


def minimal_causes(evaluator: Evaluator, settings: FloatArray, unsafe: Unsafe) -> list[list[MinimalCause]]:
    """For each of M settings, shape (M, n), all smallest unsafe subsets of its changes; none where no subset is unsafe.

    The empty subset counts: a study whose original vehicle is unsafe needs no change.
    """
    original = evaluator.characteristics.original
    changed = [tuple(np.flatnonzero(row).tolist()) for row in evaluator.characteristics.changed(settings)]
    causes: list[list[MinimalCause]] = [[] for _ in settings]
    for size in range(max(map(len, changed), default=0) + 1):
        subsets = [_Subset(setting, columns) for setting, group in enumerate(changed) if not causes[setting]
                   for columns in combinations(group, size)]
        for start in range(0, len(subsets), CHUNK):
            chunk = subsets[start:start + CHUNK]
            partial = np.tile(original, (len(chunk), 1))
            for row, (setting, columns) in enumerate(chunk):
                partial[row, list(columns)] = settings[setting, list(columns)]
            evaluations = evaluator.evaluate(partial, f"subsets of {size} changes")
            for row in np.flatnonzero(unsafe.of(evaluations)).tolist():
                causes[chunk[row].setting].append(
                    MinimalCause(chunk[row].columns, partial[row], str(evaluations.outcome[row]), finite_or_none(evaluations.f_safe[row])))
    return causes


def expected_cost(changes: int) -> int:
    """Estimated number of subsets of the changes that are simulated until the smallest unsafe subsets appear.

    Causes are assumed to have half of the changes, about as in the shipped studies.
    """
    return sum(comb(changes, size) for size in range((changes + 1) // 2 + 1))


def affordable(settings: FloatArray, evaluator: Evaluator, limit: int) -> list[int]:
    """Rows of settings whose minimal causes take about `limit` simulations or fewer: all, or a random sample of them."""
    costs = [expected_cost(int(changes)) for changes in evaluator.characteristics.number_changed(settings)]
    if sum(costs) <= limit:
        return list(range(len(settings)))
    order = np.random.default_rng(evaluator.study.search.seed).permutation(len(settings))
    is_affordable = np.cumsum([costs[row] for row in order]) <= limit
    return sorted(order[is_affordable].tolist())


def necessary(causes: Sequence[MinimalCause]) -> frozenset[int]:
    """Columns that every one of a setting's minimal causes needs."""
    return frozenset.intersection(*(frozenset(cause.columns) for cause in causes)) if causes else frozenset()


def involved(causes: Sequence[MinimalCause]) -> frozenset[int]:
    """Columns that one of a setting's minimal causes needs."""
    return frozenset(column for cause in causes for column in cause.columns)


GRID = 32
"""Number of points first simulated on a line: an unsafe stretch at least as long as their distance cannot be missed."""
FINER = 8
"""Number of parts into which the interval with the boundary is divided, `ROUNDS` times."""
ROUNDS = 3
RESOLUTION = 1 / (GRID * FINER**ROUNDS)
"""Accuracy of a boundary, as a share of the line."""


class End(StrEnum):
    """State just below the smallest unsafe share of a line."""

    SAFE = "safe"
    FILTER = "filter threshold"
    NOT_SIMULATED = "not simulated"


class Boundary(NamedTuple):
    """The smallest unsafe share of a cause's changes, and the setting there, shape (n,).

    `alone` has for each column the value to which its change can be reduced while the other changes stay. `end` is the state
    just below the share; if that is the filter's threshold, `at_threshold` is the column whose change the filter undoes.
    """

    fraction: float
    setting: FloatArray
    alone: dict[int, float]
    end: End = End.SAFE
    at_threshold: int | None = None


def boundaries(evaluator: Evaluator, causes: list[MinimalCause], unsafe: Unsafe) -> list[Boundary]:
    """Shrink causes, all changes by a common factor and each alone, as far as they stay unsafe and above the filter's thresholds."""
    all_changes = [(cause, cause.columns) for cause in causes]
    single_changes = [(cause, (column,)) for cause in causes for column in cause.columns]
    lines = [Line.from_original(evaluator, cause, columns) for cause, columns in [*all_changes, *single_changes]]
    fractions, ends = edges(evaluator, lines, unsafe)
    single_edges = iter(zip(lines[len(causes):], fractions[len(causes):], strict=True))
    result = []
    for i, cause in enumerate(causes):
        if not cause.columns:
            result.append(Boundary(0.0, cause.setting, {}))
            continue
        alone = {}
        for column in cause.columns:
            line, fraction = next(single_edges)
            alone[column] = float(line.at(np.array([fraction]))[0, column])
        setting = lines[i].at(fractions[i:i + 1])[0]
        limiting = lines[i].first_filtered(evaluator.characteristics.threshold) if ends[i] == End.FILTER else None
        result.append(Boundary(float(fractions[i]), setting, alone, ends[i], limiting))
    return result


class Line(NamedTuple):
    """Settings from `start` to `end`, shape (n,) each; the search leaves out shares of the line up to `lowest`."""

    start: FloatArray
    end: FloatArray
    lowest: float

    @classmethod
    def from_original(cls, evaluator: Evaluator, cause: MinimalCause, columns: tuple[int, ...]) -> Line:
        """The line on which some columns of a cause go from the original to their values."""
        members = evaluator.characteristics
        indices = list(columns)
        start = cause.setting.copy()
        start[indices] = members.original[indices]
        distances = np.abs(cause.setting - members.original)[indices]
        return cls(start, cause.setting, float(np.max(members.threshold[indices] / distances, initial=0.0)))

    def first_filtered(self, threshold: FloatArray) -> int:
        """The column whose change first falls to the filter's threshold on the way back."""
        distance = np.abs(self.end - self.start)
        return int(np.argmax(np.divide(threshold, distance, out=np.zeros_like(distance), where=distance > 0)))

    def at(self, shares: FloatArray) -> FloatArray:
        """Settings at shares of the line, shape (K, n)."""
        part = shares[:, np.newaxis]
        return np.where(part >= 1, self.end, self.start + part * (self.end - self.start))


def first_unsafe(evaluator: Evaluator, lines: list[Line], unsafe: Unsafe, stage: str = "boundaries") -> FloatArray:
    """The first unsafe share of every line, whose end is unsafe; exact to `RESOLUTION` of the line above `lowest`."""
    return edges(evaluator, lines, unsafe, stage)[0]


def edges(evaluator: Evaluator, lines: list[Line], unsafe: Unsafe, stage: str = "boundaries") -> tuple[FloatArray, list[End]]:
    """The first unsafe share of every line as `first_unsafe`, and the state just below it.

    A point that cannot be simulated is neither safe nor unsafe: the search passes it, and reports `NOT_SIMULATED` if it ends there.
    """
    lowest = np.array([line.lowest for line in lines])
    low, high, low_is_valid = lowest, np.ones(len(lines)), np.ones(len(lines), dtype=bool)
    for parts in (GRID, *(FINER,) * ROUNDS):
        shares = low[:, np.newaxis] + (high - low)[:, np.newaxis] * np.arange(1, parts + 1) / parts
        shares[:, -1] = high
        inner = np.concatenate([line.at(group[:-1]) for line, group in zip(lines, shares, strict=True)]) if lines else np.zeros((0, 0))
        evaluations = evaluator.evaluate(inner, stage)
        is_unsafe, valid = (np.ones(shares.shape, dtype=bool) for _ in range(2))
        is_unsafe[:, :-1] = unsafe.of(evaluations).reshape(len(lines), parts - 1)
        valid[:, :-1] = evaluations.valid.reshape(len(lines), parts - 1)
        first = np.argmax(is_unsafe, axis=1)
        rows = np.arange(len(lines))
        low_is_valid = np.where(first > 0, valid[rows, np.maximum(first - 1, 0)], low_is_valid)
        low, high = np.where(first > 0, shares[rows, np.maximum(first - 1, 0)], low), shares[rows, first]
    ends = np.where((low == lowest) & (lowest > 0), End.FILTER, np.where(low_is_valid, End.SAFE, End.NOT_SIMULATED))
    return high, [End(end) for end in ends]
