"""The contract of a search algorithm, independent of SUMO, processes and files, and checks of algorithms from outside the package."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from safevar_sumo.errors import ForeignError
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import Contract, Guard, read_only_copy
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

Search = Generator[FloatArray, Evaluations, Evaluations]
"""A generator: yields k filtered settings of n characteristics, shape (k, n), receives their evaluations, and returns the run's result."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The characteristics to vary, the original vehicle's evaluation and the budget of evaluations.

    `population` is the number of settings of a generation, for algorithms with generations; `scoring` defines the objectives. `region` is
    the feasible region of a study with constraints: yielded settings must lie in this region after the filter.
    """

    characteristics: CharacteristicSet
    original: Evaluations
    evaluations: int
    population: int = 50
    scoring: Scoring = PUBLISHED_SCORING
    region: FeasibleRegion | None = None

    def uniform(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Unfiltered settings, drawn uniformly in the domains and feasible after the filter; shape (number, n)."""
        lower, upper = self.characteristics.lower, self.characteristics.upper
        if not self.region:
            return rng.uniform(lower, upper, (number, len(lower)))
        return self.region.sampled(lambda count: rng.uniform(lower, upper, (count, len(lower))), number, rng, filtered=True)

    def feasible(self, settings: FloatArray) -> BoolArray:
        """Which settings, shape (k, n), satisfy the study's constraints after the filter; shape (k,)."""
        filtered = self.characteristics.filter(settings)
        return self.region.feasible(filtered) if self.region else np.ones(len(filtered), dtype=bool)

    def repaired(self, settings: FloatArray) -> FloatArray:
        """Settings moved towards the original until they are feasible after the filter; shape (k, n)."""
        return self.region.repaired(settings) if self.region else settings


class Algorithm(Protocol):
    """A search algorithm. Its fields are the parameters that a study gives in a table such as [search.nsga2]."""

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        """One run, which requests at most `problem.evaluations` evaluations.

        All randomness comes from `rng`, because a resumed run is repeated from its journal. Yielded settings are in the domains and
        filtered. The result consists of valid evaluations (`problem.scoring.valid`) that the run received.
        """


ALGORITHM_CONTRACT = Contract.of(Algorithm, "an algorithm")


class GuardedAlgorithm:
    """An algorithm from outside the package: it gets read-only copies, and this class checks its settings and its result."""

    def __init__(self, algorithm: Algorithm, guard: Guard) -> None:
        self._algorithm, self._guard = algorithm, guard

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        search = self._guard.call("search", self._algorithm.search, read_only_copy(problem), rng)
        if not (hasattr(search, "send") and hasattr(search, "__next__")):
            raise self._guard.wrong("search", "the search", search, "a generator: a method that yields settings and returns its result")
        answers: dict[bytes, Evaluations] = {}
        answer: Evaluations | None = None
        budget = problem.evaluations
        while True:
            output, finished = self._guard.call("search", _next_output, search, answer)
            if finished:
                return self._result(output, answers, problem)
            settings = self._settings(output, problem, budget)
            budget -= len(settings)
            evaluated = yield settings
            for i, row in enumerate(settings):
                answers[row.tobytes()] = evaluated.take([i])
            answer = read_only_copy(evaluated)

    def _settings(self, output: Any, problem: Problem, budget: int) -> FloatArray:
        members = problem.characteristics
        expected = f"an array of shape (k, {len(members)}) with k from 1 to the {budget} evaluations that are left"
        if not isinstance(output, np.ndarray) or output.ndim != 2 or output.shape[1] != len(members) or not 1 <= len(output) <= budget:
            raise self._guard.wrong("search", "settings", output, expected)
        settings = self._guard.numbers("search", "settings", output, output.shape)
        for column, member in enumerate(members):
            self._guard.numbers("search", member.name, settings[:, column], (len(settings),), member.lower, member.upper)
        unfiltered_cells = np.argwhere(members.filter(settings) != settings)
        if len(unfiltered_cells):
            row, column = unfiltered_cells[0]
            raise self._guard.wrong("search", members.names[column], float(settings[row, column]),
                                    "filtered settings: problem.characteristics.filter(settings)")
        if problem.region and not problem.region.feasible(settings).all():
            problem.region.check(settings, self._guard.source, otherwise=f", for every setting that {self._guard.name} yields: "
                                 "problem.characteristics.filter(problem.repaired(settings))")
        return settings

    def _result(self, result: Any, answers: dict[bytes, Evaluations], problem: Problem) -> Evaluations:
        expected = "an Evaluations of settings that it was sent, such as evaluations.take(rows)"
        if not isinstance(result, Evaluations):
            raise self._guard.wrong("search", "its result", result, expected)
        if not answers:
            raise ForeignError(self._guard.source, f"{self._guard.name} ended in search without yielding any setting",
                               f"a generator that yields from 1 to {problem.evaluations} settings before it returns")
        rows = self._guard.numbers("search", "its result's settings", result.settings, (len(result), len(problem.characteristics)))
        if any(row.tobytes() not in answers for row in rows):
            raise self._guard.wrong("search", "its result", "settings that it never yielded", expected)
        empty = next(iter(answers.values())).take([])
        evaluations = Evaluations.concatenate([empty, *(answers[row.tobytes()] for row in rows)])
        return evaluations.take(problem.scoring.valid(evaluations))


def _next_output(search: Any, answer: Evaluations | None) -> tuple[Any, bool]:
    """What a generator yields next, or its result; and whether the generator has finished."""
    try:
        return (next(search) if answer is None else search.send(answer)), False
    except StopIteration as end:
        return end.value, True
