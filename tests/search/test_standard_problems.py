"""NSGA-II on standard problems, compared with jMetalPy."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, NamedTuple

import moocore
import numpy as np
import pytest

from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search import ALGORITHMS, Problem, Search
from safevar_sumo.vehicles import Characteristic, CharacteristicSet, FeasibleRegion
from tests.in_process import SLOW
from tests.search.test_algorithms import evaluated, steps_of
from tests.support.needs import need_library

NSGAII = need_library("jmetal.algorithm.multiobjective.nsgaii").NSGAII
FloatProblem = need_library("jmetal.core.problem").FloatProblem
SBXCrossover = need_library("jmetal.operator.crossover").SBXCrossover
PolynomialMutation = need_library("jmetal.operator.mutation").PolynomialMutation
StoppingByEvaluations = need_library(
    "jmetal.util.termination_criterion"
).StoppingByEvaluations

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
        scoring=StandardScoring(standard),
    )


def result_of(search: Search, problem: Problem) -> Evaluations:
    *_, result = steps_of(
        search,
        lambda asked: evaluated(problem.characteristics, asked, np.zeros(len(asked))),
    )
    return result  # type: ignore[no-any-return]


def front_of_ours(standard: StandardProblem, seed: int) -> FloatArray:
    problem = standard_problem(standard)
    result = result_of(
        ALGORITHMS["nsga2"]().search(problem, np.random.default_rng(seed)), problem
    )
    return problem.scoring.values(result)


def front_of_jmetal(standard: StandardProblem, seed: int) -> FloatArray:
    """The published study used jMetalPy."""

    class Theirs(FloatProblem):
        def __init__(self) -> None:
            super().__init__()
            self.lower_bound = [0.0] * standard.variables
            self.upper_bound = [1.0] * standard.variables
            self.obj_directions = [self.MINIMIZE] * len(standard.reference)

        def number_of_objectives(self) -> int:
            return len(standard.reference)

        def number_of_constraints(self) -> int:
            return 0

        def name(self) -> str:
            return "standard"

        def evaluate(self, solution: Any) -> Any:
            solution.objectives = standard.objectives(np.array([solution.variables]))[
                0
            ].tolist()
            return solution

    random.seed(seed)
    np.random.seed(seed)
    search = NSGAII(
        problem=Theirs(),
        population_size=POPULATION,
        mutation=PolynomialMutation(
            probability=1 / standard.variables, distribution_index=20
        ),
        crossover=SBXCrossover(probability=0.9, distribution_index=20),
        termination_criterion=StoppingByEvaluations(max_evaluations=EVALUATIONS),
        offspring_population_size=POPULATION,
    )
    search.run()
    front = np.array([solution.objectives for solution in search.result()])
    return np.asarray(front[moocore.is_nondominated(front)])


@SLOW
@pytest.mark.parametrize("problem", ["zdt3", "dtlz2"])
def test_hypervolumes_reach_those_of_the_second_implementation(problem: str) -> None:
    standard = PROBLEMS[problem]
    ours, others = (
        [
            moocore.hypervolume(front(standard, seed), ref=standard.reference)
            for seed in SEEDS
        ]
        for front in (front_of_ours, front_of_jmetal)
    )
    assert np.mean(ours) >= 0.98 * np.mean(others), (np.mean(ours), np.mean(others))
