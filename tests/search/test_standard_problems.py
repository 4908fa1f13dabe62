"""SPEA2 and MOCell on standard problems, compared with pymoo and jMetalPy."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import moocore
import numpy as np
import pytest
from jmetal.algorithm.multiobjective.mocell import MOCell
from jmetal.algorithm.multiobjective.nsgaii import NSGAII
from jmetal.core.problem import FloatProblem
from jmetal.operator.crossover import SBXCrossover
from jmetal.operator.mutation import PolynomialMutation
from jmetal.util.archive import CrowdingDistanceArchive
from jmetal.util.neighborhood import C9
from jmetal.util.termination_criterion import StoppingByEvaluations
from pymoo.algorithms.moo.spea2 import SPEA2, SPEA2Survival
from pymoo.core.population import Population
from pymoo.core.problem import Problem as PymooProblem
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.optimize import minimize

from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search import ALGORITHMS, Problem
from safevar_sumo.search.evolution import Individual, fitness_class
from safevar_sumo.search.genetic import select_archive
from safevar_sumo.vehicles import Characteristic, CharacteristicSet
from tests.search.problems import evaluated

EVALUATIONS, POPULATION, SEEDS = 5000, 100, range(4)


def zdt3(x: FloatArray) -> FloatArray:
    first, g = x[:, 0], 1 + 9 * x[:, 1:].mean(axis=1)
    return np.stack([first, g * (1 - np.sqrt(first / g) - first / g * np.sin(10 * np.pi * first))], axis=1)


def dtlz2(x: FloatArray) -> FloatArray:
    g, angles = 1 + ((x[:, 2:] - 0.5) ** 2).sum(axis=1), x[:, :2] * np.pi / 2
    return np.stack(
        [
            g * np.cos(angles[:, 0]) * np.cos(angles[:, 1]),
            g * np.cos(angles[:, 0]) * np.sin(angles[:, 1]),
            g * np.sin(angles[:, 0]),
        ],
        axis=1,
    )


class StandardProblem(NamedTuple):
    """The number of variables in [0, 1], the objectives, and the reference point of the hypervolume."""

    variables: int
    objectives: Callable[[FloatArray], FloatArray]
    reference: tuple[float, ...]


PROBLEMS = {"zdt3": StandardProblem(30, zdt3, (11.0, 11.0)), "dtlz2": StandardProblem(12, dtlz2, (2.0, 2.0, 2.0))}
"""A front in parts, and a concave one of three objectives."""


class Unfiltered(CharacteristicSet):
    def filter(self, settings: FloatArray) -> FloatArray:
        return settings


@dataclass
class StandardScoring:
    """The objectives of a standard problem in place of a vehicle's."""

    problem: StandardProblem
    metrics: Any = PUBLISHED_SCORING.metrics
    objectives: list[None] = field(init=False)

    def __post_init__(self) -> None:
        self.objectives = [None] * len(self.problem.reference)

    def values(self, evaluations: Evaluations) -> FloatArray:
        return self.problem.objectives(evaluations.settings - 1)

    def valid(self, evaluations: Evaluations) -> FloatArray:
        return np.ones(len(evaluations), dtype=bool)


def front_of_ours(name: str, standard: StandardProblem, seed: int) -> FloatArray:
    unit = Unfiltered(
        tuple(
            Characteristic(name=f"x{i}", unit="-", original=1.5, lower=1.0, upper=2.0)
            for i in range(standard.variables)
        )
    )
    scoring: Any = StandardScoring(standard)
    problem = Problem(
        characteristics=unit,
        original=evaluated(unit, unit.original[np.newaxis], np.zeros(1)),
        evaluations=EVALUATIONS,
        population=POPULATION,
        scoring=scoring,
    )
    search = ALGORITHMS[name]().search(problem, np.random.default_rng(seed))
    asked = next(search)
    while True:
        try:
            asked = search.send(evaluated(unit, asked, np.zeros(len(asked))))
        except StopIteration as end:
            return scoring.values(end.value)


def front_of_pymoo(standard: StandardProblem, seed: int) -> FloatArray:
    class Theirs(PymooProblem):
        def __init__(self) -> None:
            super().__init__(n_var=standard.variables, n_obj=len(standard.reference), xl=0.0, xu=1.0)

        def _evaluate(self, x: FloatArray, out: dict[str, FloatArray], *args: Any, **kwargs: Any) -> None:
            out["F"] = standard.objectives(x)

    algorithm = SPEA2(pop_size=POPULATION, crossover=SBX(prob=0.9, eta=20), mutation=PM(eta=20))
    return np.asarray(minimize(Theirs(), algorithm, ("n_eval", EVALUATIONS), seed=seed).F)


def front_of_jmetal(algorithm: Any, standard: StandardProblem, seed: int, **options: Any) -> FloatArray:
    class Theirs(FloatProblem):
        def __init__(self) -> None:
            super().__init__()
            self.lower_bound, self.upper_bound = [0.0] * standard.variables, [1.0] * standard.variables
            self.obj_directions = [self.MINIMIZE] * len(standard.reference)

        def number_of_objectives(self) -> int:
            return len(standard.reference)

        def number_of_constraints(self) -> int:
            return 0

        def name(self) -> str:
            return "standard"

        def evaluate(self, solution: Any) -> Any:
            solution.objectives = standard.objectives(np.array([solution.variables]))[0].tolist()
            return solution

    random.seed(seed)
    np.random.seed(seed)
    search = algorithm(
        problem=Theirs(),
        population_size=POPULATION,
        mutation=PolynomialMutation(probability=1 / standard.variables, distribution_index=20),
        crossover=SBXCrossover(probability=0.9, distribution_index=20),
        termination_criterion=StoppingByEvaluations(max_evaluations=EVALUATIONS),
        **options,
    )
    search.run()
    return np.array([solution.objectives for solution in search.result()])


def front_of_mocell(standard: StandardProblem, seed: int) -> FloatArray:
    neighbours, archive = C9(10, POPULATION // 10), CrowdingDistanceArchive(POPULATION)
    return front_of_jmetal(MOCell, standard, seed, neighborhood=neighbours, archive=archive)


def front_of_nsga2(standard: StandardProblem, seed: int) -> FloatArray:
    """The published study used jMetalPy."""
    front = front_of_jmetal(NSGAII, standard, seed, offspring_population_size=POPULATION)
    return front[moocore.is_nondominated(front)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "theirs", "problem"),
    [
        ("spea2", front_of_pymoo, "dtlz2"),
        ("mocell", front_of_mocell, "dtlz2"),
        ("mocell", front_of_mocell, "zdt3"),
        ("nsga2", front_of_nsga2, "zdt3"),
    ],
)
def test_hypervolumes_reach_those_of_the_second_implementation(
    name: str, theirs: Callable[[StandardProblem, int], FloatArray], problem: str
) -> None:
    standard = PROBLEMS[problem]
    ours, others = (
        [moocore.hypervolume(front, ref=standard.reference) for front in fronts]
        for fronts in (
            [front_of_ours(name, standard, seed) for seed in SEEDS],
            [theirs(standard, seed) for seed in SEEDS],
        )
    )
    assert np.mean(ours) >= 0.98 * np.mean(others), (np.mean(ours), np.mean(others))


def individuals(objectives: FloatArray) -> list[Individual]:
    population = []
    for values in objectives.tolist():
        population.append(Individual(values))
        population[-1].fitness = fitness_class(len(values))(tuple(values))
    return population


def random_front(seed: int) -> FloatArray:
    """Two to four objectives, some of whole numbers, from one layer to many, with duplicates."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(1, 80))
    objectives = rng.random((size, int(rng.integers(2, 5))))
    if seed % 3:  # on a sphere: most of them are free
        objectives /= np.linalg.norm(objectives, axis=1, keepdims=True)
    if seed % 4 == 1:  # as the number of changed characteristics
        objectives[:, -1] = rng.integers(1, 13, size)
    return np.concatenate([objectives, objectives[rng.integers(0, size, int(rng.integers(0, size + 1)))]])


def test_spea2_ranks_what_nothing_dominates_by_its_distance_to_the_third_nearest_of_four() -> None:
    """1 / (distance + 2), below one half whatever the distance: those at the ends have more room."""
    ours = individuals(np.array([[0.0, 3.0], [1.0, 2.0], [2.0, 1.0], [3.0, 0.0]]))
    select_archive(ours, 4)
    ends, middle = 1 / (3 * np.sqrt(2) + 2), 1 / (2 * np.sqrt(2) + 2)
    assert [one.standing[0] for one in ours] == pytest.approx([ends, middle, middle, ends])


@pytest.mark.slow
@pytest.mark.parametrize("hundred", range(4))
def test_survivors_of_spea2_are_those_of_pymoo_on_random_fronts(hundred: int) -> None:
    """Equal objectives, equally often; among dominated individuals of equal fitness, pymoo's sort does not define the
    last survivor.
    """
    for seed in range(100 * hundred, 100 * (hundred + 1)):
        objectives = random_front(seed)
        number = int(np.random.default_rng(seed + 10_000).integers(1, len(objectives) + 1))
        ours = individuals(objectives)
        mine = sorted(one.fitness.values for one in select_archive(ours, number))
        population = Population.new(F=objectives)
        others = SPEA2Survival().do(PymooProblem(n_obj=objectives.shape[1]), population, n_survive=number)
        assert [one.standing[0] for one in ours] == population.get("SPEA_F").tolist(), seed
        last = others.get("SPEA_F").max()
        if last < 1 or np.count_nonzero(population.get("SPEA_F") == last) == np.count_nonzero(
            others.get("SPEA_F") == last
        ):
            assert mine == sorted(map(tuple, others.get("F").tolist())), seed
        assert len(mine) == len(others)
