"""Standard problems of multi-objective search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search import Problem, Search
from safevar_sumo.vehicles import Characteristic, CharacteristicSet, FeasibleRegion
from tests.support.searches import evaluated, steps_of

EVALUATIONS, POPULATION, SEEDS = 5000, 100, range(4)


def zdt3(x: FloatArray) -> FloatArray:
    first = x[:, 0]
    g = 1 + 9 * x[:, 1:].mean(axis=1)
    return np.stack(
        [first, g * (1 - np.sqrt(first / g) - first / g * np.sin(10 * np.pi * first))],
        axis=1,
    )


def dtlz2(x: FloatArray) -> FloatArray:
    g = 1 + ((x[:, 2:] - 0.5) ** 2).sum(axis=1)
    angles = x[:, :2] * np.pi / 2
    return np.stack(
        [
            g * np.cos(angles[:, 0]) * np.cos(angles[:, 1]),
            g * np.cos(angles[:, 0]) * np.sin(angles[:, 1]),
            g * np.sin(angles[:, 0]),
        ],
        axis=1,
    )


class StandardProblem(NamedTuple):
    """The number of variables in [0, 1], the objectives, and the reference point of the
    hypervolume.
    """

    variables: int
    objectives: Callable[[FloatArray], FloatArray]
    reference: tuple[float, ...]


PROBLEMS = {
    "zdt3": StandardProblem(30, zdt3, (11.0, 11.0)),
    "dtlz2": StandardProblem(12, dtlz2, (2.0, 2.0, 2.0)),
}
"""A front in parts, and a concave one of three objectives."""


class Unfiltered(CharacteristicSet):
    def filter(self, settings: FloatArray) -> FloatArray:
        return settings


class StandardScoring:
    """The objectives of a standard problem in place of a vehicle's."""

    metrics = PUBLISHED_SCORING.metrics

    def __init__(self, problem: StandardProblem) -> None:
        self.problem = problem
        self.objectives = [None] * len(problem.reference)

    def values(self, evaluations: Evaluations) -> FloatArray:
        return self.problem.objectives(evaluations.settings - 1)

    def valid(self, evaluations: Evaluations) -> FloatArray:
        return np.ones(len(evaluations), dtype=bool)

    def violation(self, evaluations: Evaluations) -> FloatArray:
        return np.zeros(len(evaluations))


def standard_problem(
    standard: StandardProblem,
    evaluations: int = EVALUATIONS,
    population: int = POPULATION,
) -> Problem:
    unit = Unfiltered(
        tuple(
            Characteristic(name=f"x{i}", unit="-", original=1.5, lower=1.0, upper=2.0)
            for i in range(standard.variables)
        )
    )
    return Problem(
        region=FeasibleRegion(unit, ()),
        original=evaluated(unit, unit.original_settings, np.zeros(1)),
        evaluations=evaluations,
        population=population,
        scoring=cast("Any", StandardScoring(standard)),
    )


def result_of(search: Search, problem: Problem) -> Evaluations:
    *_, result = steps_of(
        search,
        lambda asked: evaluated(problem.characteristics, asked, np.zeros(len(asked))),
    )
    return result  # type: ignore[no-any-return]
