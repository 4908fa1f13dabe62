"""The contract of a search algorithm. It knows settings and evaluations, and nothing of SUMO, processes or files."""

from __future__ import annotations

from collections.abc import Generator
from typing import Protocol

import numpy as np

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet

Search = Generator[FloatArray, Evaluations, Evaluations]
"""Yields filtered settings, shape (k, n), is sent their evaluations, and returns the result of the run."""


class Algorithm(Protocol):
    """A search algorithm; its fields are its parameters."""

    def search(self, characteristics: CharacteristicSet, evaluations: int, rng: np.random.Generator) -> Search:
        """One run that asks for exactly `evaluations` settings, or fewer if the algorithm ends before.

        Everything that is random comes from `rng`.
        """
