"""The contract of a search algorithm, and checks of users' algorithms; independent of SUMO, processes and files."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np

from safevar_sumo.errors import UserCodeError
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import Guard, Legal, read_only_copy
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

Search = Generator[FloatArray, Evaluations, Evaluations]
"""A generator that yields k filtered settings of n characteristics, shape (k, n), receives their evaluations, and so
on; at its end it returns the run's result.
"""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The characteristics to vary, the original vehicle's evaluation and the budget of evaluations.

    `population` is the number of settings of a generation, for algorithms with generations; `scoring` defines the
    objectives. `region` is the feasible region of a study with constraints: yielded settings must lie in this region
    after the filter.
    """

    characteristics: CharacteristicSet
    original: Evaluations
    evaluations: int
    population: int
    scoring: Scoring = PUBLISHED_SCORING
    region: FeasibleRegion | None = None

    def uniform(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Unfiltered settings, drawn uniformly in the domains and feasible after the filter; shape (number, n)."""
        lower, upper = self.characteristics.lower, self.characteristics.upper

        def draw(count: int) -> FloatArray:
            return rng.uniform(lower, upper, (count, len(lower)))

        return self.region.draw_feasible(draw, number, rng, filtered=True) if self.region else draw(number)

    def feasible(self, settings: FloatArray) -> BoolArray:
        """Which settings, shape (k, n), satisfy the study's constraints after the filter; shape (k,)."""
        filtered = self.characteristics.filter(settings)
        return self.region.feasible(filtered) if self.region else np.ones(len(filtered), dtype=bool)

    def repaired(self, settings: FloatArray) -> FloatArray:
        """Settings moved towards the original until they are feasible after the filter; shape (k, n)."""
        return self.region.repaired(settings) if self.region else settings


class Algorithm:
    """A search algorithm. Its fields are the parameters that a study gives in a table such as [search.nsga2].

    `title` is its name in tables and legends, by default its name in the study.
    """

    __slots__ = ()
    title: str = ""

    @abstractmethod
    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        """One run, which requests at most `problem.evaluations` evaluations.

        All randomness comes from `rng`, so that a run which is resumed, with the evaluations of its journal, yields the
        same settings again. Yielded settings are in the domains and filtered. The result consists of valid evaluations
        (`problem.scoring.valid`) that the run received.
        """


class GuardedAlgorithm(Algorithm):
    """A user's algorithm: it gets read-only copies, and this class checks its settings and its result."""

    def __init__(self, algorithm: Algorithm, guard: Guard) -> None:
        self._algorithm, self._guard, self.title = algorithm, guard, getattr(algorithm, "title", "")

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        search = self._guard.call("search", self._algorithm.search, read_only_copy(problem), rng)
        if not (hasattr(search, "send") and hasattr(search, "__next__")):
            raise self._guard.wrong_value(
                "search", "the search", search, "a generator: a method that yields settings and returns its result"
            )
        evaluations_by_setting: dict[bytes, Evaluations] = {}
        last_answer: Evaluations | None = None
        budget = problem.evaluations
        while True:
            output, has_finished = self._guard.call("search", _advance, search, last_answer)
            if has_finished:
                return self._check_result(output, evaluations_by_setting, problem)
            settings = self._check_settings(output, problem, budget)
            budget -= len(settings)
            evaluations = yield settings
            for i, setting in enumerate(settings):
                evaluations_by_setting[setting.tobytes()] = evaluations.take([i])
            last_answer = read_only_copy(evaluations)

    def _check_settings(self, output: Any, problem: Problem, budget: int) -> FloatArray:
        characteristics = problem.characteristics
        expected = (
            f"an array of shape (k, {len(characteristics)}) with k from 1 to the {budget} evaluations that are left"
        )
        is_matrix = isinstance(output, np.ndarray) and output.ndim == 2
        if not is_matrix or output.shape[1] != len(characteristics) or not 1 <= len(output) <= budget:
            raise self._guard.wrong_value("search", "settings", output, expected)
        settings = self._guard.numbers("search", "settings", output, output.shape)
        for characteristic, values in zip(characteristics, settings.T, strict=True):
            legal = Legal(characteristic.lower, characteristic.upper)
            self._guard.numbers("search", characteristic.name, values, (len(settings),), legal)
        unfiltered_values = np.argwhere(characteristics.filter(settings) != settings)
        if len(unfiltered_values):
            row, column = unfiltered_values[0]
            raise self._guard.wrong_value(
                "search",
                characteristics.names[column],
                float(settings[row, column]),
                "filtered settings: problem.characteristics.filter(settings)",
            )
        if problem.region and not problem.region.feasible(settings).all():
            problem.region.check(
                settings,
                self._guard.source,
                otherwise=f", for every setting that {self._guard.name} yields: "
                "problem.characteristics.filter(problem.repaired(settings))",
            )
        return settings

    def _check_result(
        self, result: Any, evaluations_by_setting: dict[bytes, Evaluations], problem: Problem
    ) -> Evaluations:
        expected = "an Evaluations of settings that it was sent, such as evaluations.take(rows)"
        if not isinstance(result, Evaluations):
            raise self._guard.wrong_value("search", "its result", result, expected)
        if not evaluations_by_setting:
            raise UserCodeError(
                self._guard.source,
                f"{self._guard.name} ended in search without yielding any setting",
                f"a generator that yields from 1 to {problem.evaluations} settings before it returns",
            )
        settings = self._guard.numbers(
            "search", "its result's settings", result.settings, (len(result), len(problem.characteristics))
        )
        if any(setting.tobytes() not in evaluations_by_setting for setting in settings):
            raise self._guard.wrong_value("search", "its result", "settings that it never yielded", expected)
        empty = next(iter(evaluations_by_setting.values())).take([])
        evaluations = Evaluations.concatenate(
            [empty, *(evaluations_by_setting[setting.tobytes()] for setting in settings)]
        )
        return evaluations.take(problem.scoring.valid(evaluations))


def _advance(search: Any, last_answer: Evaluations | None) -> tuple[Any, bool]:
    """Advance a generator; returns what it yields or, at its end, its result; and whether it has finished."""
    try:
        return (next(search) if last_answer is None else search.send(last_answer)), False
    except StopIteration as end:
        return end.value, True
