"""Elitist searches: NSGA-II (Deb et al. 2002) on DEAP, as published (method section 6); SPEA2 (Zitzler et al. 2001)."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.search.evolution import (
    Individual,
    Operators,
    Size,
    Variation,
    initial_population,
    join_evaluations,
    objectives_of,
    request_evaluations,
    set_front_standings,
    sort_into_fronts,
)


class Nsga2(Operators, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Elitist search by rank and crowding distance; as many offspring as individuals; SBX, polynomial mutation.

    The variables are the characteristics' unfiltered values; simulation and results use filtered ones.
    The default mutation probability is 1/n per variable. The result is the non-dominated part of the last population.
    A setting whose simulation failed does not survive.
    """

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        variation = Variation(self, problem, rng)
        offspring, population, used = initial_population(problem, rng), list[Individual](), 0
        while offspring:
            used += yield from request_evaluations(offspring, problem)
            valid_offspring = [individual for individual in offspring if not individual.has_failed]
            population = select_survivors(population + valid_offspring, problem.population)
            offspring = variation.draw_offspring(population, min(problem.population, problem.evaluations - used))
        return join_evaluations([individual for individual in population if individual.standing[0] == 0], problem)


def select_survivors(individuals: list[Individual], number: int) -> list[Individual]:
    """Select the best `number` by rank, then by crowding distance, as DEAP's `selNSGA2` does; compiled code sorts
    faster.
    """
    sorted_individuals = sorted(individuals, key=lambda individual: individual.fitness.wvalues, reverse=True)
    best: list[Individual] = []
    for rank, front in enumerate(sort_into_fronts(sorted_individuals)):
        set_front_standings(front, rank)
        best += sorted(front, key=lambda individual: individual.standing)
        if len(best) >= number:
            break
    return best[:number]


class Spea2(Operators, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Elitist search by strength and density; an archive, thinned where it is densest, produces the next population.

    The variables are the characteristics' unfiltered values; simulation and results use filtered ones. The result is
    the non-dominated part of the last archive. A setting whose simulation failed does not survive.

    Parameters
    ----------
    crossover_probability, crossover_index
        Probability and distribution index of simulated binary crossover.
    mutation_probability, mutation_index
        Probability per variable, by default 1/n, and distribution index of polynomial mutation.
    tournament_size
        Number of individuals in a tournament.
    archive
        Size of the archive, by default the population size.
    normalised
        Whether objectives are divided by their range before distances are computed, as metres, fractions and counts
        have no common unit. The publication does not normalise.
    """

    archive: Size | None = None
    normalised: bool = True

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        variation, size = Variation(self, problem, rng), self.archive or problem.population
        offspring, archive, used = initial_population(problem, rng), list[Individual](), 0
        while offspring:
            used += yield from request_evaluations(offspring, problem)
            valid_offspring = [individual for individual in offspring if not individual.has_failed]
            archive = select_archive(archive + valid_offspring, size, normalised=self.normalised)
            offspring = variation.draw_distinct_offspring(archive, min(problem.population, problem.evaluations - used))
        return join_evaluations([individual for individual in archive if individual.standing[0] < 1], problem)


def select_archive(individuals: list[Individual], size: int, *, normalised: bool = False) -> list[Individual]:
    """The publication's environmental selection; sets `standing` to the fitness, which is below 1 for non-dominated
    individuals.
    """
    if not individuals:
        return []
    objectives = objectives_of(individuals)
    dominates = domination_matrix(objectives)
    distances = _distances(_scale_to_unit_range(objectives) if normalised else objectives)
    fitness = _raw_fitness(dominates) + _density(distances)
    for individual, value in zip(individuals, fitness.tolist(), strict=True):
        individual.standing = (value,)
    is_nondominated = ~dominates.any(axis=0)
    selection = _truncate(np.flatnonzero(is_nondominated), distances, size)
    dominated = np.flatnonzero(~is_nondominated)
    selection += dominated[np.argsort(fitness[dominated], kind="stable")][: size - len(selection)].tolist()
    return [individuals[i] for i in selection]


def domination_matrix(objectives: FloatArray) -> BoolArray:
    """Whether row i dominates row j; shape (M, M)."""
    first, second = objectives[:, np.newaxis], objectives[np.newaxis]
    return np.asarray((first <= second).all(axis=2) & (first < second).any(axis=2))


def _raw_fitness(dominates: BoolArray) -> FloatArray:
    """Raw fitness: the sum of the strengths of the individuals that dominate; the strength is the number of dominated
    individuals.
    """
    strength = np.count_nonzero(dominates, axis=1)
    return np.asarray(np.where(dominates, strength[:, np.newaxis], 0).sum(axis=0), dtype=float)


def _density(distances: FloatArray) -> FloatArray:
    """1 / (distance to the k-th nearest individual + 2); k is the root of the number of individuals, and counts from 0
    as in pymoo.
    """
    k = min(int(np.sqrt(len(distances))), len(distances) - 1)
    return np.asarray(1 / (np.sort(distances, axis=1)[:, k] + 2))


def _distances(objectives: FloatArray) -> FloatArray:
    """Euclidean distances, infinite from a row to itself; summed objective by objective, so that they do not depend on
    the shape.
    """
    squares = np.zeros((len(objectives), len(objectives)))
    for column in objectives.T:
        squares += (column[:, np.newaxis] - column) ** 2
    distances = np.sqrt(squares)
    np.fill_diagonal(distances, np.inf)
    return distances


def _scale_to_unit_range(objectives: FloatArray) -> FloatArray:
    """Objectives scaled to [0, 1]."""
    least = objectives.min(axis=0)
    width = objectives.max(axis=0) - least
    return np.asarray((objectives - least) / np.where(width > 0, width, 1.0))


def _truncate(indices: np.ndarray, distances: FloatArray, number: int) -> list[int]:
    """Remove the individual with the nearest neighbour, one by one, until `number` are left; the second nearest decides
    ties, and so on.
    """
    kept: list[int] = indices.tolist()
    while len(kept) > number:
        pair_distances = distances[np.ix_(kept, kept)]
        nearest = pair_distances.min(axis=1)
        tied = np.flatnonzero(nearest == nearest.min())
        del kept[tied[np.lexsort(np.sort(pair_distances[tied], axis=1).T[::-1])[0]]]
    return kept
