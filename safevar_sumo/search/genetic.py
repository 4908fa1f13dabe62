"""NSGA-II (Deb et al. 2002) with the operators of DEAP: the published crossover, mutation and
crowding distance.
"""

from __future__ import annotations

import random
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from operator import attrgetter
from threading import Lock
from typing import Annotated

import moocore
import numpy as np
from deap import base, tools
from msgspec import Meta

from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search.base import Algorithm, Problem, Search
from safevar_sumo.study import Table

Probability = Annotated[float, Meta(ge=0, le=1)]
DistributionIndex = Annotated[float, Meta(ge=0, le=1000)]
TournamentSize = Annotated[int, Meta(ge=2, le=1000)]
MAX_MISSES = 50
"""Largest number of consecutive draws without a feasible child. After the next draw without a
feasible child, its children are repaired.
"""

_ONE_AT_A_TIME = Lock()
"""This lock is held while DEAP draws from Python's global `random`."""


@cache
def fitness_class(objective_count: int) -> type:
    """The class of DEAP's fitness for this number of objectives, all of which are minimised."""

    def initialise(self: base.Fitness, values: tuple[float, ...] = ()) -> None:
        # DEAP's constructor also checks the type of the weights, which takes longer than the rest.
        if values:
            self.values = values

    return type(
        "Fitness",
        (base.Fitness,),
        {"weights": (-1.0,) * objective_count, "__init__": initialise},
    )


class Individual(list[float]):
    """The unfiltered values of a setting.

    Attributes
    ----------
    fitness
        The values of the objectives, after the evaluation.
    evaluation
        The batch of evaluations with this setting, and its row in the batch, after the evaluation.
    violation
        The part of the required clearance that the original vehicle lacks in the same encounter; 0
        if the original vehicle is safe, or if a study searches no encounters.
    standing
        The place of the individual among survivors, as a tuple to compare: less is better.
    """

    fitness: base.Fitness
    evaluation: tuple[Evaluations, int]
    violation: float = 0.0
    standing: tuple[float, ...]


class Nsga2(Algorithm, Table, frozen=True, kw_only=True):
    """Elitist search by Pareto rank and crowding distance, with as many offspring as individuals.

    NSGA-II combines values before the filter, which resets small changes to the original value;
    simulations and results have values after the filter. The default mutation probability is 1/n
    per variable; crossover is simulated binary, mutation polynomial, both bounded by the domains. A
    tournament has `tournament_size` individuals. NSGA-II returns the non-dominated part of the last
    population. A vehicle whose simulation failed does not survive. If the search also varies the
    encounter, an encounter in which the original vehicle is safe is better than another encounter.
    If the original vehicle is unsafe in two encounters, the better encounter is the one in which
    less of the required clearance is missing.
    """

    crossover_probability: Probability = 0.9
    crossover_index: DistributionIndex = 20.0
    mutation_probability: Probability | None = None
    mutation_index: DistributionIndex = 20.0
    tournament_size: TournamentSize = 2

    def search(
        self,
        problem: Problem,
        rng: np.random.Generator,
        generation: FloatArray | None = None,
    ) -> Search:
        reproduction = Reproduction(self, problem, rng)
        if generation is None:
            generation = problem.uniform(
                min(problem.population, problem.evaluations), rng
            )
        offspring = [Individual(setting) for setting in generation.tolist()]
        survivors = list[Individual]()
        used = 0

        while offspring:
            alive = yield from request_evaluations(offspring, problem)
            used += len(offspring)
            survivors = select_survivors(survivors + alive, problem.population)
            offspring = reproduction.draw_offspring(
                survivors, min(problem.population, problem.evaluations - used)
            )
        batches = [
            individual.evaluation
            for individual in survivors
            if individual.standing[0] == 0
        ]
        front = [evaluations.take([row]) for evaluations, row in batches]
        return Evaluations.concatenate([problem.original.take([]), *front])


class Reproduction:
    """Draws the offspring of a run. DEAP draws from the global `random`: see `_randomness`."""

    def __init__(
        self, operators: Nsga2, problem: Problem, rng: np.random.Generator
    ) -> None:
        characteristics = problem.characteristics
        self._problem = problem
        self._operators = operators
        self._random_state = random.Random(int(rng.integers(2**63))).getstate()
        self._misses = 0
        probability = operators.mutation_probability
        if probability is None:
            probability = 1 / len(characteristics)
        self._mutation_probability = probability
        self._domains = characteristics.lower.tolist(), characteristics.upper.tolist()

    @contextmanager
    def _randomness(self) -> Iterator[None]:
        """Within the block, the global `random` has the state of this run. Afterwards it has the
        caller's state again.
        """
        # Without the lock, another thread could draw from this run's state.
        with _ONE_AT_A_TIME:
            state_of_caller = random.getstate()
            random.setstate(self._random_state)
            try:
                yield
            finally:
                self._random_state = random.getstate()
                random.setstate(state_of_caller)

    def draw_offspring(
        self, population: list[Individual], number: int
    ) -> list[Individual]:
        """Draw `number` new individuals in pairs: two tournaments choose the parents, then
        crossover and mutation change the pair.
        """
        offspring = list[Individual]()
        operators = self._operators
        with self._randomness():
            while population and len(offspring) < number:
                pair = [
                    Individual(run_tournament(population, operators.tournament_size))
                    for _ in range(2)
                ]
                if random.random() <= operators.crossover_probability:
                    tools.cxSimulatedBinaryBounded(
                        *pair, operators.crossover_index, *self._domains
                    )
                for child in pair:
                    tools.mutPolynomialBounded(
                        child,
                        operators.mutation_index,
                        *self._domains,
                        self._mutation_probability,
                    )
                offspring += self._feasible_children(pair)
        return offspring[:number]

    def _feasible_children(self, children: list[Individual]) -> list[Individual]:
        """The children that satisfy the study's constraints. The caller draws again for missing
        children.

        Under constrained domination (Deb 2000), a feasible individual dominates every infeasible
        individual. All individuals are feasible, so an infeasible child would not survive: it is
        not simulated. After more than `MAX_MISSES` draws in a row without a feasible child, the
        children are moved towards the original until they are feasible.
        """
        if not self._problem.region:
            return children
        feasible = self._problem.feasible(np.array(children))
        self._misses += 1
        if feasible.any():
            self._misses = 0
        if self._misses > MAX_MISSES:
            self._misses = 0
            settings = self._problem.repaired(np.array(children))
            return [Individual(setting) for setting in settings.tolist()]
        return [
            child
            for child, is_feasible in zip(children, feasible, strict=True)
            if is_feasible
        ]


def request_evaluations(
    individuals: Sequence[Individual], problem: Problem
) -> Generator[FloatArray, Evaluations, list[Individual]]:
    """Request the evaluations of individuals, and store them in the individuals. Return the
    individuals that could be scored.
    """
    evaluated = yield problem.characteristics.filter(np.array(individuals))
    scoring = problem.scoring
    fitness = fitness_class(len(problem.scoring.objectives))
    violations = scoring.violation(evaluated)
    is_scored = np.where(
        violations > 0, np.isfinite(violations), scoring.valid(evaluated)
    )
    values = scoring.values(evaluated)

    scored = []
    for row, individual in enumerate(individuals):
        individual.evaluation = (evaluated, row)
        individual.violation = float(violations[row])
        individual.fitness = fitness(tuple(values[row].tolist()))
        if is_scored[row]:
            scored.append(individual)
    return scored


def select_survivors(individuals: list[Individual], number: int) -> list[Individual]:
    """Select the best `number` individuals, and set the `standing` of each individual.

    The order is that of DEAP's `selNSGA2`, which is slower: first the rank, from 0, then the larger
    crowding distance. Infeasible individuals follow all feasible individuals, in the order of their
    violations (constrained domination, Deb et al. 2002). Each infeasible individual has a rank of
    its own.
    """
    feasible = [individual for individual in individuals if not individual.violation]
    infeasible = [individual for individual in individuals if individual.violation]
    infeasible.sort(key=attrgetter("violation"))
    for place, individual in enumerate(infeasible):
        individual.standing = len(individuals) + place, 0.0
    best_first = sorted(feasible, key=attrgetter("fitness.wvalues"), reverse=True)
    best = []
    for rank, front in enumerate(sort_into_fronts(best_first)):
        tools.emo.assignCrowdingDist(front)
        for individual in front:
            individual.standing = rank, -individual.fitness.crowding_dist
        best += sorted(front, key=attrgetter("standing"))
        if len(best) >= number:
            break
    return [*best, *infeasible][:number]


def sort_into_fronts(individuals: Sequence[Individual]) -> list[list[Individual]]:
    """Group individuals by their rank of non-domination. Each group keeps the given order."""
    if not individuals:
        return []
    # DEAP's weighted values are the negative objectives: larger values are better.
    ranks = moocore.pareto_rank(
        [individual.fitness.wvalues for individual in individuals], maximise=True
    ).tolist()
    fronts: list[list[Individual]] = [[] for _ in range(max(ranks) + 1)]
    for individual, rank in zip(individuals, ranks, strict=True):
        fronts[rank].append(individual)
    return fronts


def run_tournament(population: list[Individual], size: int = 2) -> Individual:
    """The best of `size` individuals, drawn without replacement, by `standing`. Chance decides
    between equal individuals.
    """
    # With a single individual, nothing may be drawn: a draw would change all later random numbers.
    if len(population) == 1:
        return population[0]
    best, *rivals = random.sample(population, min(size, len(population)))
    for rival in rivals:
        if rival.standing < best.standing or (
            rival.standing == best.standing and random.random() >= 0.5
        ):
            best = rival
    return best
