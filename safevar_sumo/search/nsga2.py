"""NSGA-II (Deb et al. 2002) on DEAP, set as in the published study (method section 6)."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from deap import base, tools
from msgspec import Struct

from safevar_sumo.records import Evaluations
from safevar_sumo.search.base import Search
from safevar_sumo.vehicles import CharacteristicSet


class _Fitness(base.Fitness):  # type: ignore[misc]
    weights = (-1.0, -1.0, -1.0)


class _Individual(list[float]):
    """Unfiltered values of a setting, its rank in the population, and where its evaluation stands."""

    def __init__(self, values: list[float]) -> None:
        super().__init__(values)
        self.fitness = _Fitness()
        self.evaluation = self.rank = -1


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

    def search(self, characteristics: CharacteristicSet, evaluations: int, rng: np.random.Generator) -> Search:
        variation = _Variation(self, characteristics, random.Random(int(rng.integers(2**63))))
        archive: list[Evaluations] = []
        size = min(self.population, evaluations)
        initial = rng.uniform(characteristics.lower, characteristics.upper, (size, len(characteristics)))
        brood = [_Individual(values) for values in initial.tolist()]
        population: list[_Individual] = []
        done = 0
        while brood:
            filtered = characteristics.filter(np.array(brood))
            evaluated = yield filtered
            for i, individual in enumerate(brood):
                individual.evaluation = done + i
                individual.fitness.values = tuple(evaluated.objectives[i].tolist())
            archive.append(evaluated)
            done += len(brood)
            population += [individual for individual, valid in zip(brood, evaluated.valid, strict=True) if valid]
            population = _survivors(population, self.population)
            brood = variation.offspring(population, min(self.population, evaluations - done))
        return Evaluations.concatenate(archive).take([one.evaluation for one in population if one.rank == 0])


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
