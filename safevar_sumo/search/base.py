"""The contract of a search algorithm. It knows settings and evaluations, and nothing of SUMO, processes or files."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from safevar_sumo.metrics import SAFEVAR, Scoring
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet

Search = Generator[FloatArray, Evaluations, Evaluations]
"""Yields filtered settings, shape (k, n), is sent their evaluations, and returns the result of the run."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is searched: the characteristics, the original vehicle's evaluation, how many evaluations there are, and for what.

    `population` is how many settings a generation has, as far as an algorithm knows generations; `scoring` gives the
    objectives of evaluations.
    """

    characteristics: CharacteristicSet
    original: Evaluations
    evaluations: int
    population: int = 50
    scoring: Scoring = SAFEVAR

    def uniform(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Unfiltered settings drawn uniformly in the domains; shape (number, n)."""
        lower, upper = self.characteristics.lower, self.characteristics.upper
        return rng.uniform(lower, upper, (number, len(lower)))


class Algorithm(Protocol):
    """A search algorithm. Its fields are the parameters that a study gives in a table such as [search.nsga2]."""

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        """One run, which asks for the problem's number of evaluations, or fewer if the algorithm ends before.

        Everything that is random comes from `rng`: a run that is resumed is run again from its journal. What is yielded
        is in the domains and filtered. The result holds evaluations that the run was sent; one that is not valid
        (`problem.scoring.valid`) is none of them.
        """
