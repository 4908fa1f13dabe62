"""NSGA-II (Deb et al. 2002) on DEAP, configured as in the published study (method section 6)."""

from __future__ import annotations

import numpy as np

from safevar_sumo.search.base import Problem, Search
from safevar_sumo.search.evolution import (
    Individual,
    Operators,
    Variation,
    initial_population,
    join_evaluations,
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
