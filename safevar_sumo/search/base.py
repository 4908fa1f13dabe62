"""The contract of a search algorithm. It knows settings and evaluations, and nothing of SUMO, processes or files."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import SearchTable
from safevar_sumo.vehicles import CharacteristicSet

Search = Generator[FloatArray, Evaluations, Evaluations]
"""Yields filtered settings, shape (k, n), is sent their evaluations, and returns the result of the run."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is searched: the characteristics, the original vehicle's evaluation, and how many evaluations there are."""

    characteristics: CharacteristicSet
    original: Evaluations
    evaluations: int

    def uniform(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Unfiltered settings drawn uniformly in the domains; shape (number, n)."""
        lower, upper = self.characteristics.lower, self.characteristics.upper
        return rng.uniform(lower, upper, (number, len(lower)))


class Algorithm(Protocol):
    """A search algorithm; its fields are its parameters."""

    @classmethod
    def of(cls, table: SearchTable) -> Self:
        """The algorithm as a study's search table sets it."""

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        """One run, which asks for the problem's number of evaluations, or fewer if the algorithm ends before.

        Everything that is random comes from `rng`. An evaluation that is not `valid` never gets into the result.
        """
