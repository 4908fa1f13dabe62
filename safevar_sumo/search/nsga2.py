"""NSGA-II (Deb et al. 2002) on DEAP, set as in the published study (method section 6)."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

import numpy as np
from deap import base, tools
from msgspec import Struct

from safevar_sumo.records import Evaluations
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.study import SearchTable
from safevar_sumo.vehicles import CharacteristicSet


class _Fitness(base.Fitness):  # type: ignore[misc]
    weights = (-1.0, -1.0, -1.0)


class _Individual(list[float]):
    """Unfiltered values of a setting, its evaluation (of one row), and its rank in the population."""

    evaluation: Evaluations
    rank: int

    def __init__(self, values: list[float]) -> None:
        super().__init__(values)
        self.fitness = _Fitness()


class Nsga2(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Elitist search by rank and crowding distance; population = offspring, SBX, polynomial mutation.

    The variables are the characteristics' unfiltered values; what is simulated and reported is filtered.
    Mutation has probability 1/n per variable. The result is the non-dominated part of the last population.
    A setting whose simulation failed does not survive.
    """

    population: int
    crossover_probability: float = 0.9
    crossover_index: float = 20.0
    mutation_index: float = 20.0

    @classmethod
    def of(cls, table: SearchTable) -> Self:
        return cls(population=table.population)

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        characteristics = problem.characteristics
        variation = _Variation(self, characteristics, random.Random(int(rng.integers(2**63))))
        initial = problem.uniform(min(self.population, problem.evaluations), rng)
        brood = [_Individual(values) for values in initial.tolist()]
        population: list[_Individual] = []
        asked = 0
        while brood:
            evaluated = yield characteristics.filter(np.array(brood))
            for i, (individual, objectives) in enumerate(zip(brood, evaluated.objectives.tolist(), strict=True)):
                individual.evaluation = evaluated.take([i])
                individual.fitness.values = tuple(objectives)
            asked += len(brood)
            population = _survivors(population + [one for one in brood if one.evaluation.valid[0]], self.population)
            brood = variation.offspring(population, min(self.population, problem.evaluations - asked))
        front = [one.evaluation for one in population if one.rank == 0]
        return Evaluations.concatenate(front) if front else evaluated.take([])


class _Variation:
    """Draws offspring; DEAP's own random state is set and restored around every draw."""

    def __init__(self, settings: Nsga2, characteristics: CharacteristicSet, generator: random.Random) -> None:
        self._settings, self._state = settings, generator.getstate()
        self._lower, self._upper = characteristics.lower.tolist(), characteristics.upper.tolist()

    @contextmanager
    def randomness(self) -> Iterator[None]:
        """DEAP draws from the global `random`: lend it this run's state, give the caller's back."""
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
                first, second = (_Individual(list(_tournament(population))) for _ in range(2))
                if random.random() <= self._settings.crossover_probability:
                    tools.cxSimulatedBinaryBounded(first, second, self._settings.crossover_index, self._lower, self._upper)
                for child in (first, second):
                    tools.mutPolynomialBounded(child, self._settings.mutation_index, self._lower, self._upper, 1 / len(child))
                    children.append(child)
        return children[:number]


def _survivors(individuals: list[_Individual], number: int) -> list[_Individual]:
    """The best `number` by rank, then by crowding distance: DEAP's `selNSGA2`, which forgets the ranks that it finds."""
    survivors: list[_Individual] = []
    for rank, front in enumerate(tools.sortLogNondominated(individuals, number) if individuals else []):
        tools.emo.assignCrowdingDist(front)
        for one in front:
            one.rank = rank
        survivors += sorted(front, key=lambda one: -one.fitness.crowding_dist)
    return survivors[:number]


def _tournament(population: list[_Individual]) -> _Individual:
    """The better of two that are drawn without replacement: by rank, then by crowding distance, then by chance."""
    if len(population) == 1:
        return population[0]
    first, second = random.sample(population, 2)
    keys = [(one.rank, -one.fitness.crowding_dist) for one in (first, second)]
    if keys[0] == keys[1]:
        return first if random.random() < 0.5 else second
    return first if keys[0] < keys[1] else second
