"""Random search, the baseline of the published study (method section 6)."""

from __future__ import annotations

from typing import Self

import moocore
import numpy as np
from msgspec import Struct

from safevar_sumo.records import Evaluations
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.study import SearchTable


class RandomSearch(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Uniform in the domains; the result is the non-dominated archive over all evaluations.

    Parameters
    ----------
    generation
        How many settings are asked for at once; never changes what they are.
    """

    generation: int

    @classmethod
    def of(cls, table: SearchTable) -> Self:
        return cls(generation=table.population)

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        settings = problem.characteristics.filter(problem.uniform(problem.evaluations, rng))
        archive: Evaluations | None = None
        for start in range(0, len(settings), self.generation):
            evaluated = yield settings[start:start + self.generation]
            archive = _non_dominated(evaluated if archive is None else Evaluations.concatenate([archive, evaluated]))
        assert archive is not None
        return archive


def _non_dominated(evaluations: Evaluations) -> Evaluations:
    """The valid evaluations that no other one dominates; those with equal objectives all stay."""
    valid = evaluations.take(evaluations.valid)
    return valid.take(moocore.is_nondominated(valid.objectives, keep_weakly=True)) if len(valid) else valid
