"""NSGA-II (Deb et al. 2002) on DEAP, set as in the published study (method section 6)."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Annotated, Any

import moocore
import numpy as np
from deap import base, tools
from msgspec import Meta, Struct

from safevar_sumo.records import Evaluations
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.vehicles import CharacteristicSet

Probability = Annotated[float, Meta(ge=0, le=1)]
Index = Annotated[float, Meta(ge=0, le=1000)]


@cache
def _fitness(objectives: int) -> type[Any]:
    """The class of a fitness with a number of objectives, all minimised."""
    return type("Fitness", (base.Fitness,), {"weights": (-1.0,) * objectives})


class _Individual(list[float]):
    """Unfiltered values of a setting; once evaluated, its fitness, and its `evaluation`: a batch and its row in it.

    A survivor's `standing` is its rank, from 0, and minus its crowding distance: less is better.
    """

    fitness: base.Fitness
    evaluation: tuple[Evaluations, int]
    standing: tuple[int, float]


class Nsga2(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Elitist search by rank and crowding distance; population = offspring, SBX, polynomial mutation.

    The variables are the characteristics' unfiltered values; what is simulated and reported is filtered.
    Mutation has by default the probability 1/n per variable. The result is the non-dominated part of the last population.
    A setting whose simulation failed does not survive.
    """

    crossover_probability: Probability = 0.9
    crossover_index: Index = 20.0
    mutation_probability: Probability | None = None
    mutation_index: Index = 20.0
    tournament_size: Annotated[int, Meta(ge=2, le=1000)] = 2

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        characteristics = problem.characteristics
        variation = _Variation(self, characteristics, random.Random(int(rng.integers(2**63))))
        initial = problem.uniform(min(problem.population, problem.evaluations), rng)
        brood = [_Individual(values) for values in initial.tolist()]
        population: list[_Individual] = []
        asked, fitness = 0, _fitness(len(problem.scoring.objectives))
        while brood:
            evaluated = yield characteristics.filter(np.array(brood))
            for i, (individual, objectives) in enumerate(zip(brood, problem.scoring.values(evaluated).tolist(), strict=True)):
                individual.evaluation, individual.fitness = (evaluated, i), fitness(tuple(objectives))
            asked += len(brood)
            good = [individual for individual, valid in zip(brood, problem.scoring.valid(evaluated), strict=True) if valid]
            population = _survivors(population + good, problem.population)
            brood = variation.offspring(population, min(problem.population, problem.evaluations - asked))
        front = [evaluations.take([row]) for evaluations, row in (best.evaluation for best in population if best.standing[0] == 0)]
        return Evaluations.concatenate(front) if front else evaluated.take([])


class _Variation:
    """Draws offspring; DEAP's own random state is set and restored around every draw."""

    def __init__(self, settings: Nsga2, characteristics: CharacteristicSet, generator: random.Random) -> None:
        self._settings, self._state = settings, generator.getstate()
        given = settings.mutation_probability
        self._mutation = 1 / len(characteristics) if given is None else given
        self._lower, self._upper = characteristics.lower.tolist(), characteristics.upper.tolist()

    @contextmanager
    def randomness(self) -> Iterator[None]:
        """Run with this run's state of the global `random`, which DEAP draws from; restore the caller's."""
        callers = random.getstate()
        random.setstate(self._state)
        try:
            yield
        finally:
            self._state = random.getstate()
            random.setstate(callers)

    def offspring(self, population: list[_Individual], number: int) -> list[_Individual]:
        """`number` new individuals: two tournaments, crossover, mutation, pair by pair."""
        children: list[_Individual] = []
        with self.randomness():
            while population and len(children) < number:
                first, second = (_Individual(_tournament(population, self._settings.tournament_size)) for _ in range(2))
                if random.random() <= self._settings.crossover_probability:
                    tools.cxSimulatedBinaryBounded(first, second, self._settings.crossover_index, self._lower, self._upper)
                for child in (first, second):
                    tools.mutPolynomialBounded(child, self._settings.mutation_index, self._lower, self._upper, self._mutation)
                    children.append(child)
        return children[:number]


def _survivors(individuals: list[_Individual], number: int) -> list[_Individual]:
    """The best `number` by rank, then by crowding distance; DEAP's `selNSGA2`, sorted by compiled code."""
    ordered = sorted(individuals, key=lambda individual: individual.fitness.wvalues, reverse=True)
    survivors: list[_Individual] = []
    for rank, front in enumerate(_fronts(ordered)):
        tools.emo.assignCrowdingDist(front)
        for individual in front:
            individual.standing = rank, -individual.fitness.crowding_dist
        survivors += sorted(front, key=lambda individual: individual.standing)
        if len(survivors) >= number:
            break
    return survivors[:number]


def _fronts(individuals: list[_Individual]) -> list[list[_Individual]]:
    """Individuals by non-domination rank, in their given order."""
    if not individuals:
        return []
    ranks = moocore.pareto_rank([individual.fitness.wvalues for individual in individuals], maximise=True).tolist()
    fronts: list[list[_Individual]] = [[] for _ in range(max(ranks) + 1)]
    for individual, rank in zip(individuals, ranks, strict=True):
        fronts[rank].append(individual)
    return fronts


def _tournament(population: list[_Individual], size: int = 2) -> _Individual:
    """The best of `size` individuals drawn without replacement: by rank, crowding distance, then chance."""
    if len(population) == 1:
        return population[0]
    best, *others = random.sample(population, min(size, len(population)))
    for other in others:
        if other.standing < best.standing or (other.standing == best.standing and random.random() >= 0.5):
            best = other
    return best
