"""The boundary between what is safe and what is unsafe on a straight way: the last safe value
before some failures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray

PARTS, ROUNDS = 8, 4
"""Each of `ROUNDS` rounds divides the interval from a safe to an unsafe value into `PARTS` parts.
"""
MOVED_BEFORE = 8
"""Number of failures, the nearest to the safe value, in whose encounters the last safe value is
safe at once.
"""


class Tested(Protocol):
    """A model in which settings are tested, such as `models.Model`."""

    def left(self, settings: FloatArray, stage: str) -> FloatArray:
        """What each of M settings leaves to the limit, shape (M,): below 0 it is unsafe; infinite
        where it does not count.
        """

    def are_unsafe(self, settings: FloatArray, stage: str) -> BoolArray:
        """Which of M settings are unsafe, shape (M,)."""


class Move:
    """The way of one column from a safe value to the nearest of some failures, shape (K, n): to the
    last value before it that is safe in the encounters of them all.

    Attributes
    ----------
    safe, failure
        The last safe value, and the failure just beyond it, shape (n,).
    """

    def __init__(self, column: int, start: float, failures: FloatArray) -> None:
        self.column = column
        self.safe = start
        order = np.argsort(np.abs(failures[:, column] - start), kind="stable")
        self.encounters = failures[order[:MOVED_BEFORE]]
        self.failure = self.encounters[0]

    @property
    def _values(self) -> FloatArray:
        """The values of a round."""
        return np.asarray(
            self.safe + (self.failure[self.column] - self.safe) * np.arange(1, PARTS) / PARTS
        )

    @property
    def settings(self) -> FloatArray:
        """The settings of a round, shape (K (`PARTS` - 1), n)."""
        settings = np.repeat(self.encounters, PARTS - 1, axis=0)
        settings[:, self.column] = np.tile(self._values, len(self.encounters))
        return settings

    def narrow(self, are_unsafe: BoolArray) -> None:
        """Take what a round gave."""
        is_unsafe = are_unsafe.reshape(len(self.encounters), PARTS - 1)
        values = self._values
        first = int(np.argmax(np.append(is_unsafe.any(axis=0), True)))
        self.safe = self.safe if first == 0 else float(values[first - 1])
        if first < len(values):
            self.failure = self.encounters[np.argmax(is_unsafe[:, first])].copy()
            self.failure[self.column] = values[first]


def find_boundaries(moves: Sequence[Move], model: Tested, stage: str) -> None:
    """Carry out moves before failures in a model, side by side."""
    for _ in range(ROUNDS):
        settings = [each.settings for each in moves]
        are_unsafe = model.are_unsafe(np.concatenate(settings), stage)
        parts = np.split(are_unsafe, np.cumsum([*map(len, settings)])[:-1])
        for each, part in zip(moves, parts, strict=True):
            each.narrow(part)
