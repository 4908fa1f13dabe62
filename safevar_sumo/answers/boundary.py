"""How little of a change is enough: along a line from safe to unsafe, the first place that is unsafe."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.causes import MinimalCause
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.records import FloatArray

GRID = 32
"""Places that a line is looked at first: an island of unsafety as wide as one of them is not skipped."""
FINER = 8
"""Into how many parts the last safe part is divided, again and again."""
ROUNDS = 3
RESOLUTION = 1 / (GRID * FINER**ROUNDS)
"""How near to the truth a boundary is, as a share of the line."""


class Boundary(NamedTuple):
    """The smallest unsafe share of a cause's changes, and the setting there, shape (n,).

    `alone` are, by column, the values that the changes can be taken back to one at a time, the others as they are.
    """

    fraction: float
    setting: FloatArray
    alone: dict[int, float]


def boundaries(bench: Bench, causes: list[MinimalCause], unsafe: Unsafe) -> list[Boundary]:
    """Shrink causes, all changes by a common factor and each alone, as far as they stay unsafe.

    No change is shrunk into what the filter takes for none.
    """
    together = [(cause, cause.columns) for cause in causes]
    alone = [(cause, (column,)) for cause in causes for column in cause.columns]
    lines = [Line.moving(bench, cause, columns) for cause, columns in [*together, *alone]]
    fractions = first_unsafe(bench, lines, unsafe)
    single = iter(zip(lines[len(causes):], fractions[len(causes):], strict=True))
    shrunk = []
    for i, cause in enumerate(causes):
        if not cause.columns:
            shrunk.append(Boundary(0.0, cause.setting, {}))
            continue
        of_it = {}
        for column in cause.columns:
            line, fraction = next(single)
            of_it[column] = float(line.at(np.array([fraction]))[0, column])
        shrunk.append(Boundary(float(fractions[i]), lines[i].at(fractions[i:i + 1])[0], of_it))
    return shrunk


class Line(NamedTuple):
    """Settings from `start` to `end`, shape (n,) each; those at the share `lowest` of it and below do not count."""

    start: FloatArray
    end: FloatArray
    lowest: float

    @classmethod
    def moving(cls, bench: Bench, cause: MinimalCause, columns: tuple[int, ...]) -> Line:
        """The line on which some columns of a cause go from the original to their values."""
        members = bench.characteristics
        which = list(columns)
        start = cause.setting.copy()
        start[which] = members.original[which]
        ways = np.abs(cause.setting - members.original)[which]
        return cls(start, cause.setting, float(np.max(members.threshold[which] / ways, initial=0.0)))

    def at(self, shares: FloatArray) -> FloatArray:
        """Settings at shares of the line, shape (K, n)."""
        part = shares[:, np.newaxis]
        return np.where(part >= 1, self.end, self.start + part * (self.end - self.start))


def first_unsafe(bench: Bench, lines: list[Line], unsafe: Unsafe, what: str = "boundaries") -> FloatArray:
    """The first unsafe share of every line, whose end is unsafe; exact to `RESOLUTION` of what counts of it."""
    low, high = np.array([line.lowest for line in lines]), np.ones(len(lines))
    for parts in (GRID, *(FINER,) * ROUNDS):
        shares = low[:, np.newaxis] + (high - low)[:, np.newaxis] * np.arange(1, parts + 1) / parts
        shares[:, -1] = high
        inner = np.concatenate([line.at(of_it[:-1]) for line, of_it in zip(lines, shares, strict=True)]) if lines else np.zeros((0, 0))
        is_unsafe = np.ones(shares.shape, dtype=bool)
        is_unsafe[:, :-1] = unsafe.of(bench.evaluate(inner, what)).reshape(len(lines), parts - 1)
        first = np.argmax(is_unsafe, axis=1)
        rows = np.arange(len(lines))
        low, high = np.where(first > 0, shares[rows, np.maximum(first - 1, 0)], low), shares[rows, first]
    return high
