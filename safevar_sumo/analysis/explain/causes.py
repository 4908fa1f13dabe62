"""Minimal causes: the smallest subsets of a setting's changes that are unsafe by themselves.

Outcomes need not be monotone: a change may undo the effect of another change. So all subsets of a size are simulated,
size by size, until some are unsafe. These are minimal, as no smaller subset is unsafe.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from itertools import combinations, islice
from math import comb
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray, finite_or_none

MAX_SUBSETS = 20_000
"""Maximum number of subsets simulated in one call; further subsets are made only after it, which bounds the memory."""


class MinimalCause(NamedTuple):
    """A smallest unsafe subset of a setting's changes: the columns that keep their changed values, and the outcome.

    `setting` has shape (n,); `safety_degree` is in m, or -m/s.
    """

    columns: tuple[int, ...]
    setting: FloatArray
    outcome: str
    safety_degree: float | None


class _Subset(NamedTuple):
    """A subset of the changes of one setting."""

    row: int
    columns: tuple[int, ...]


def find_minimal_causes(evaluator: Evaluator, settings: FloatArray, unsafe: Unsafe) -> list[list[MinimalCause]]:
    """All smallest unsafe subsets of the changes of each of M settings, shape (M, n); an empty list if no subset is
    unsafe.

    The empty subset counts too: if the original vehicle is unsafe, no change is needed.
    """
    original = evaluator.characteristics.original
    columns_by_row = [tuple(np.flatnonzero(flags).tolist()) for flags in evaluator.characteristics.changed(settings)]
    causes: list[list[MinimalCause]] = [[] for _ in settings]
    for size in range(max(map(len, columns_by_row), default=0) + 1):
        open_rows = [row for row in range(len(settings)) if not causes[row]]
        subsets = (_Subset(row, columns) for row in open_rows for columns in combinations(columns_by_row[row], size))
        while chunk := list(islice(subsets, MAX_SUBSETS)):
            partial_settings = np.tile(original, (len(chunk), 1))
            for index, (row, columns) in enumerate(chunk):
                partial_settings[index, list(columns)] = settings[row, list(columns)]
            evaluations = evaluator.evaluate(partial_settings, f"subsets of {size} changes")
            for index in np.flatnonzero(unsafe.of(evaluations)).tolist():
                subset, degree = chunk[index], finite_or_none(evaluations.f_safe[index])
                cause = MinimalCause(subset.columns, partial_settings[index], str(evaluations.outcome[index]), degree)
                causes[subset.row].append(cause)
    return causes


def estimate_subset_count(changes: int) -> int:
    """Estimated number of subsets to simulate, for a setting with this number of changes, until the smallest unsafe
    subsets appear.

    The estimate assumes causes with half of the changes, about as in the shipped studies.
    """
    return sum(comb(changes, size) for size in range((changes + 1) // 2 + 1))


def select_affordable_rows(settings: FloatArray, evaluator: Evaluator, max_evaluations: int) -> list[int]:
    """Rows whose minimal causes together take at most about `max_evaluations`: all rows of `settings`, or a random
    sample.
    """
    costs = [estimate_subset_count(int(changes)) for changes in evaluator.characteristics.number_changed(settings)]
    if sum(costs) <= max_evaluations:
        return list(range(len(settings)))
    order = np.random.default_rng(evaluator.study.search.seed).permutation(len(settings))
    is_affordable = np.cumsum([costs[row] for row in order]) <= max_evaluations
    return sorted(order[is_affordable].tolist())


def necessary_columns(causes: Sequence[MinimalCause]) -> frozenset[int]:
    """Columns that all minimal causes of a setting contain."""
    return frozenset.intersection(*(frozenset(cause.columns) for cause in causes)) if causes else frozenset()


def involved_columns(causes: Sequence[MinimalCause]) -> frozenset[int]:
    """Columns that at least one minimal cause of a setting contains."""
    return frozenset(column for cause in causes for column in cause.columns)


LINE_SETTINGS = 32
"""Number of settings first simulated on each `Line`. The search finds every unsafe stretch of the line that is as long
as their spacing.
"""
PARTS_PER_ROUND = 8
"""Number of parts into which each of `ROUNDS` rounds divides the interval with the boundary."""
ROUNDS = 3
SHORT_DIGITS = (3, 4, 5, 6, 8)
"""Numbers of significant digits that commands may print."""
SHORT_DEGREE = 0.01
"""Difference of safety degrees that a rounded setting may make [m, or m/s]."""
RESOLUTION = 1 / (LINE_SETTINGS * PARTS_PER_ROUND**ROUNDS)
"""Accuracy of a boundary, as a share of the line."""


class BoundaryState(StrEnum):
    """What lies on a line just below its smallest unsafe share."""

    SAFE = "safe"
    FILTER = "filter threshold"
    NOT_SIMULATED = "not simulated"


class Boundary(NamedTuple):
    """The smallest unsafe share of a cause's changes, and the setting there, shape (n,).

    `single_limits` has for each column the value to which its change can be reduced while the other changes stay.
    `state_below` is the state just below `fraction`; at the filter's threshold, `at_threshold` is the column whose
    change the filter removes.
    """

    fraction: float
    setting: FloatArray
    single_limits: dict[int, float]
    state_below: BoundaryState = BoundaryState.SAFE
    at_threshold: int | None = None


def find_boundaries(evaluator: Evaluator, causes: list[MinimalCause], unsafe: Unsafe) -> list[Boundary]:
    """Shrink causes, all changes by a common factor and each change by itself, while they stay unsafe and above the
    filter's thresholds.
    """
    all_changes = [(cause, cause.columns) for cause in causes]
    single_changes = [(cause, (column,)) for cause in causes for column in cause.columns]
    lines = [Line.from_original(evaluator, cause, columns) for cause, columns in [*all_changes, *single_changes]]
    fractions, states = find_boundary_shares(evaluator, lines, unsafe)
    single_shares = iter(zip(lines[len(causes) :], fractions[len(causes) :], strict=True))
    boundaries = []
    for cause, line, fraction, state in zip(
        causes, lines, fractions, states, strict=False
    ):  # the lines of single changes follow
        if not cause.columns:
            boundaries.append(Boundary(0.0, cause.setting, {}))
            continue
        single_limits = {}
        for column in cause.columns:
            single_line, single_fraction = next(single_shares)
            single_limits[column] = float(single_line.settings_at(np.array([single_fraction]))[0, column])
        setting = line.settings_at(np.array([fraction]))[0]
        filtered_column = (
            line.first_filtered(evaluator.characteristics.threshold) if state == BoundaryState.FILTER else None
        )
        boundaries.append(Boundary(float(fraction), setting, single_limits, state, filtered_column))
    return boundaries


def shorten(evaluator: Evaluator, settings: FloatArray, unsafe: Unsafe) -> FloatArray:
    """K unsafe settings, shape (K, n), in as few digits as they need to stay unsafe with the same safety degree to 1
    cm.
    """
    characteristics = evaluator.characteristics
    rounded = [
        np.array([[float(f"{value:.{digits}g}") for value in setting] for setting in settings.tolist()])
        for digits in SHORT_DIGITS
    ]
    candidates = np.array(
        [
            *(
                np.where(
                    settings == characteristics.original,
                    settings,
                    characteristics.filter(np.clip(values, characteristics.lower, characteristics.upper)),
                )
                for values in rounded
            ),
            settings,
        ]
    )
    evaluations = evaluator.evaluate(candidates.reshape(-1, settings.shape[1]), "digits of commands")
    outcome, degree, is_unsafe = (
        values.reshape(len(candidates), -1)
        for values in (evaluations.outcome, evaluations.f_safe, unsafe.of(evaluations))
    )
    changes_alike = (characteristics.changed(candidates) == characteristics.changed(settings)).all(axis=2)
    ends_alike = changes_alike & is_unsafe & (outcome == outcome[-1]) & (np.abs(degree - degree[-1]) < SHORT_DEGREE)
    ends_alike[-1] = True
    return np.asarray(candidates[np.argmax(ends_alike, axis=0), np.arange(len(settings))])


class Line(NamedTuple):
    """A straight line of settings from `start` to `end`, shape (n,) each; the search begins above the share `lowest` of
    the line.
    """

    start: FloatArray
    end: FloatArray
    lowest: float

    @classmethod
    def from_original(cls, evaluator: Evaluator, cause: MinimalCause, columns: tuple[int, ...]) -> Line:
        """The line on which some columns of a cause go from their original values to their values in the cause."""
        characteristics = evaluator.characteristics
        indices = list(columns)
        start = cause.setting.copy()
        start[indices] = characteristics.original[indices]
        distances = np.abs(cause.setting - characteristics.original)[indices]
        return cls(start, cause.setting, float(np.max(characteristics.threshold[indices] / distances, initial=0.0)))

    def first_filtered(self, threshold: FloatArray) -> int:
        """The column whose change first falls to the filter's threshold on the way from `end` to `start`."""
        distance = np.abs(self.end - self.start)
        return int(np.argmax(np.divide(threshold, distance, out=np.zeros_like(distance), where=distance > 0)))

    def settings_at(self, shares: FloatArray) -> FloatArray:
        """The settings at K shares of the line, shape (K, n)."""
        factors = shares[:, np.newaxis]
        return np.where(factors >= 1, self.end, self.start + factors * (self.end - self.start))


def find_first_unsafe_shares(
    evaluator: Evaluator, lines: list[Line], unsafe: Unsafe, stage: str = "boundaries"
) -> FloatArray:
    """The first unsafe share of every line; its end must be unsafe. The error is at most `RESOLUTION` times the line
    above `lowest`.
    """
    return find_boundary_shares(evaluator, lines, unsafe, stage)[0]


def find_boundary_shares(
    evaluator: Evaluator, lines: list[Line], unsafe: Unsafe, stage: str = "boundaries"
) -> tuple[FloatArray, list[BoundaryState]]:
    """The first unsafe share of every line, as `find_first_unsafe_shares`, and what lies just below this share.

    A setting that cannot be simulated is neither safe nor unsafe; just below the share, it gives the state
    `NOT_SIMULATED`.
    """
    lowest = np.array([line.lowest for line in lines])
    low, high, low_is_valid = lowest, np.ones(len(lines)), np.ones(len(lines), dtype=bool)
    for parts in (LINE_SETTINGS, *(PARTS_PER_ROUND,) * ROUNDS):
        shares = low[:, np.newaxis] + (high - low)[:, np.newaxis] * np.arange(1, parts + 1) / parts
        shares[:, -1] = high
        settings_by_line = [line.settings_at(line_shares[:-1]) for line, line_shares in zip(lines, shares, strict=True)]
        inner_settings = np.concatenate(settings_by_line) if lines else np.zeros((0, 0))
        evaluations = evaluator.evaluate(inner_settings, stage)
        is_unsafe, is_valid = (np.ones(shares.shape, dtype=bool) for _ in range(2))
        is_unsafe[:, :-1] = unsafe.of(evaluations).reshape(len(lines), parts - 1)
        is_valid[:, :-1] = evaluations.valid.reshape(len(lines), parts - 1)
        index = np.argmax(is_unsafe, axis=1)
        rows = np.arange(len(lines))
        low_is_valid = np.where(index > 0, is_valid[rows, np.maximum(index - 1, 0)], low_is_valid)
        low, high = np.where(index > 0, shares[rows, np.maximum(index - 1, 0)], low), shares[rows, index]
    states = np.where(low_is_valid, BoundaryState.SAFE, BoundaryState.NOT_SIMULATED)
    return high, [
        BoundaryState(state) for state in np.where((low == lowest) & (lowest > 0), BoundaryState.FILTER, states)
    ]
