"""Random search, the baseline of the published study (method section 6)."""

from __future__ import annotations

import moocore
import numpy as np
from msgspec import Struct

from safevar_sumo.metrics import Scoring
from safevar_sumo.records import Evaluations
from safevar_sumo.search.base import Algorithm, Problem, Search


class RandomSearch(Algorithm, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Samples uniformly in the domains; the result is the non-dominated archive over all evaluations."""

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        settings = problem.characteristics.filter(problem.uniform(problem.evaluations, rng))
        archive: Evaluations | None = None
        for start in range(0, len(settings), problem.population):
            evaluated = yield settings[start : start + problem.population]
            archive = _keep_non_dominated(
                evaluated if archive is None else Evaluations.concatenate([archive, evaluated]), problem.scoring
            )
        assert archive is not None
        return archive


def _keep_non_dominated(evaluations: Evaluations, scoring: Scoring) -> Evaluations:
    """The valid non-dominated evaluations, including all with equal objectives."""
    valid = evaluations.take(scoring.valid(evaluations))
    return valid.take(moocore.is_nondominated(scoring.values(valid), keep_weakly=True)) if len(valid) else valid
