"""NSGA-II on standard problems, compared with jMetalPy."""

from __future__ import annotations

import random
from typing import Any

import moocore
import numpy as np
import pytest

from safevar_sumo.records import FloatArray
from safevar_sumo.search import ALGORITHMS
from tests.support.in_process import SLOW
from tests.support.needs import need_library
from tests.support.standard_problems import (
    EVALUATIONS,
    POPULATION,
    PROBLEMS,
    SEEDS,
    StandardProblem,
    result_of,
    standard_problem,
)

NSGAII = need_library("jmetal.algorithm.multiobjective.nsgaii").NSGAII
FloatProblem = need_library("jmetal.core.problem").FloatProblem
SBXCrossover = need_library("jmetal.operator.crossover").SBXCrossover
PolynomialMutation = need_library("jmetal.operator.mutation").PolynomialMutation
StoppingByEvaluations = need_library(
    "jmetal.util.termination_criterion"
).StoppingByEvaluations


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
