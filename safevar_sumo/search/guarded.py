"""A search algorithm from outside the package, held to its contract."""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from safevar_sumo.errors import ForeignError
from safevar_sumo.plugins import Contract, Guard, read_only_copy
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Algorithm, Problem, Search

ALGORITHM_CONTRACT = Contract.of(Algorithm, "an algorithm")


class GuardedAlgorithm:
    """Checks what a search asks for and what it returns; the problem and all evaluations that it gets are read-only copies."""

    def __init__(self, algorithm: Algorithm, guard: Guard) -> None:
        self._algorithm, self._guard = algorithm, guard

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        search = self._guard.call("search", self._algorithm.search, read_only_copy(problem), rng)
        if not (hasattr(search, "send") and hasattr(search, "__next__")):
            raise self._guard.wrong("search", "the search", search, "a generator: a method that yields settings and returns its result")
        known: dict[bytes, Evaluations] = {}
        answer: Evaluations | None = None
        left = problem.evaluations
        while True:
            asked, over = self._step(search, answer)
            if over:
                return self._result(asked, known, problem)
            settings = self._settings(asked, problem, left)
            left -= len(settings)
            evaluated = yield settings
            for i, row in enumerate(settings):
                known[row.tobytes()] = evaluated.take([i])
            answer = read_only_copy(evaluated)

    def _step(self, search: Any, answer: Evaluations | None) -> tuple[Any, bool]:
        """What the search yields next, or what it returns in the end."""
        before = random.getstate(), np.random.get_state()[1].tobytes()  # type: ignore[index]
        try:
            found = self._guard.call("search", _next, search, answer)
        finally:
            after = random.getstate(), np.random.get_state()[1].tobytes()  # type: ignore[index]
        if before != after:
            raise ForeignError(self._guard.source, f"{self._guard.name} draws from a global random generator in search",
                               "everything random from `rng`: a run is repeated when it is resumed")
        return found  # type: ignore[no-any-return]

    def _settings(self, asked: Any, problem: Problem, left: int) -> FloatArray:
        members = problem.characteristics
        legal = f"an array of shape (k, {len(members)}) with k from 1 to the {left} evaluations that are left"
        if not isinstance(asked, np.ndarray) or asked.ndim != 2 or asked.shape[1] != len(members) or not 1 <= len(asked) <= left:
            raise self._guard.wrong("search", "settings", asked, legal)
        settings = self._guard.numbers("search", "settings", asked, asked.shape)
        for column, member in enumerate(members):
            self._guard.numbers("search", member.name, settings[:, column], (len(settings),), member.lower, member.upper)
        unfiltered = np.argwhere(members.filter(settings) != settings)
        if len(unfiltered):
            row, column = unfiltered[0]
            raise self._guard.wrong("search", members.names[column], float(settings[row, column]),
                                    "filtered settings: problem.characteristics.filter(settings)")
        return settings

    def _result(self, found: Any, known: dict[bytes, Evaluations], problem: Problem) -> Evaluations:
        legal = "an Evaluations of settings that it was sent, such as evaluations.take(rows)"
        if not isinstance(found, Evaluations):
            raise self._guard.wrong("search", "its result", found, legal)
        if not known:
            raise ForeignError(self._guard.source, f"{self._guard.name} ended in search without asking for any setting",
                               f"a generator that yields from 1 to {problem.evaluations} settings before it returns")
        rows = self._guard.numbers("search", "its result's settings", found.settings, (len(found), len(problem.characteristics)))
        if any(row.tobytes() not in known for row in rows):
            raise self._guard.wrong("search", "its result", "settings that it never asked for", legal)
        nothing = next(iter(known.values())).take([])
        result = Evaluations.concatenate([nothing, *(known[row.tobytes()] for row in rows)])
        return result.take(problem.scoring.valid(result))


def _next(search: Any, answer: Evaluations | None) -> tuple[Any, bool]:
    try:
        return (next(search) if answer is None else search.send(answer)), False
    except StopIteration as end:
        return end.value, True
