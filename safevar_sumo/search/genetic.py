"""Genetic algorithms: NSGA-II, SPEA2 and MOCell.

NSGA-II (Deb et al. 2002) is on DEAP, as published (method section 6); SPEA2 is by Zitzler et al. (2001). MOCell (Nebro
et al. 2009) is synchronous here, so that a generation is one batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from functools import partial
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.search.evolution import (
    Individual,
    Operators,
    Reproduction,
    Size,
    initial_population,
    join_evaluations,
    request_evaluations,
    set_front_standings,
    set_standings,
    sort_into_fronts,
)


class Nsga2(Operators, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Elitist search by rank and crowding distance, with as many offspring as individuals.

    The variables are the characteristics' unfiltered values; simulation and results use filtered ones.
    The default mutation probability is 1/n per variable. The result is the non-dominated part of the last population.
    A setting whose simulation failed does not survive.
    """

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        return _search_elitist(self, problem, rng, partial(select_survivors, number=problem.population))


def _search_elitist(
    operators: Operators,
    problem: Problem,
    rng: np.random.Generator,
    select: Callable[[list[Individual]], list[Individual]],
    *,
    distinct: bool = False,
) -> Search:
    """Search with survivors, which `select` chooses from the previous survivors and their offspring.

    `select` also sets their `standing`. Its first number is below 1 for non-dominated survivors, who are the result.
    `distinct` is explained in `Reproduction.draw_offspring`.
    """
    reproduction = Reproduction(operators, problem, rng)
    offspring, survivors, used = initial_population(problem, rng), list[Individual](), 0
    while offspring:
        used += yield from request_evaluations(offspring, problem)
        survivors = select(survivors + [individual for individual in offspring if not individual.has_failed])
        number = min(problem.population, problem.evaluations - used)
        offspring = reproduction.draw_offspring(survivors, number, distinct=distinct)
    return join_evaluations([individual for individual in survivors if individual.standing[0] < 1], problem)


def select_survivors(individuals: list[Individual], number: int) -> list[Individual]:
    """Select the best `number` by rank, then by crowding distance, as DEAP's slower `selNSGA2` does."""
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
        select = partial(select_archive, size=self.archive or problem.population, normalised=self.normalised)
        return _search_elitist(self, problem, rng, select, distinct=True)


def select_archive(individuals: list[Individual], size: int, *, normalised: bool = False) -> list[Individual]:
    """The publication's environmental selection; sets `standing` to the fitness, which is below 1 for non-dominated
    individuals.

    An individual's fitness is the sum of the strengths of all that dominate it, plus the density 1 / (distance to its
    k-th nearest individual + 2). An individual's strength is the number of individuals that it dominates; k is the root
    of the number of individuals, and counts from 0 as in pymoo.
    """
    if not individuals:
        return []
    objectives = np.array([individual.fitness.values for individual in individuals])
    rows, columns = objectives[:, np.newaxis], objectives[np.newaxis]
    dominates = (rows <= columns).all(axis=2) & (rows < columns).any(axis=2)
    if normalised:
        width = np.ptp(objectives, axis=0)
        objectives = (objectives - objectives.min(axis=0)) / np.where(width > 0, width, 1.0)
    squares = np.zeros((len(objectives), len(objectives)))
    for column in objectives.T:  # summed objective by objective, so that sums do not depend on the shape
        squares += (column[:, np.newaxis] - column) ** 2
    distances = np.sqrt(squares)
    np.fill_diagonal(distances, np.inf)
    k = min(int(np.sqrt(len(distances))), len(distances) - 1)
    strengths = np.count_nonzero(dominates, axis=1)
    fitness = strengths @ dominates + 1 / (np.sort(distances, axis=1)[:, k] + 2)
    for individual, value in zip(individuals, fitness.tolist(), strict=True):
        individual.standing = (value,)
    is_dominated = dominates.any(axis=0)
    selection = _truncate(np.flatnonzero(~is_dominated), distances, size)
    dominated = np.flatnonzero(is_dominated)
    selection += dominated[np.argsort(fitness[dominated], kind="stable")][: size - len(selection)].tolist()
    return [individuals[i] for i in selection]


def _truncate(indices: np.ndarray, distances: FloatArray, number: int) -> list[int]:
    """Remove the individual with the nearest neighbour, one by one, until `number` are left; the second nearest
    neighbour decides ties, and so on.
    """
    remaining: list[int] = indices.tolist()
    while len(remaining) > number:
        pair_distances = distances[np.ix_(remaining, remaining)]
        nearest = pair_distances.min(axis=1)
        tied = np.flatnonzero(nearest == nearest.min())
        neighbours = np.sort(pair_distances[tied], axis=1)  # nearest first
        del remaining[tied[np.lexsort(neighbours.T[::-1])[0]]]  # `lexsort` sorts by its last key first
    return remaining


GridSide = Annotated[int, Meta(ge=1, le=100_000)]
CROSS = ((-1, 0), (1, 0), (0, 1), (0, -1))
NEIGHBOURHOODS = {"von_neumann": CROSS, "moore": (*CROSS, (-1, 1), (-1, -1), (1, 1), (1, -1))}
"""Offsets, in rows and columns, from a cell to its 4 or 8 neighbours."""


class MoCell(Operators, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cells on a toroidal grid that mate with their neighbours and with an archive of non-dominated individuals.

    All cells reproduce at once, from the previous grid. A child replaces its cell's individual if the child dominates,
    or if neither dominates and the child is not the worst of the neighbourhood. The variables are the characteristics'
    unfiltered values; simulation and results use filtered ones. The result is the archive.

    Parameters
    ----------
    crossover_probability, crossover_index
        Probability and distribution index of simulated binary crossover.
    mutation_probability, mutation_index
        Probability per variable, by default 1/n, and distribution index of polynomial mutation.
    tournament_size
        Number of individuals in a tournament.
    archive
        Size of the archive, by default the population size; the archive is thinned by crowding distance.
    grid
        Rows and columns, whose product is the population; by default as close to a square as possible.
    neighbourhood
        Neighbours of a cell: the adjacent 4 (von_neumann) or 8 (moore) cells.
    """

    archive: Size | None = None
    grid: tuple[GridSide, GridSide] | None = None
    neighbourhood: Literal["moore", "von_neumann"] = "moore"

    def grid_sides(self, population: int, source: str = "search.mocell") -> tuple[int, int]:
        """Rows and columns of the grid.

        Raises
        ------
        InputError
            If the product of the two numbers is not the population.
        """
        if self.grid is None:
            rows = next(side for side in range(math.isqrt(population), 0, -1) if population % side == 0)
            return rows, population // rows
        if math.prod(self.grid) != population:
            raise InputError(
                source,
                f"search.mocell.grid = {list(self.grid)} has {math.prod(self.grid)} cells",
                f"two sides whose product is search.population = {population}",
            )
        return self.grid

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        neighbours = self._neighbours(problem.population)
        reproduction, size = Reproduction(self, problem, rng), self.archive or problem.population
        cells = initial_population(problem, rng)
        used = yield from request_evaluations(cells, problem)
        archive = update_archive([], cells, size)
        while used < problem.evaluations and archive:
            set_standings([cell for cell in cells if not cell.has_failed])
            neighbourhoods = [[cells[i] for i in indices if not cells[i].has_failed] for indices in neighbours]
            with reproduction.randomness():
                offspring = [
                    reproduction.draw_child(mates or archive, archive)  # without mates if they all failed
                    for mates in neighbourhoods[: problem.evaluations - used]
                ]
            used += yield from request_evaluations(offspring, problem)
            families = zip(cells, offspring, neighbourhoods, strict=False)  # the last generation may be incomplete
            cells[: len(offspring)] = [choose_survivor(cell, child, mates) for cell, child, mates in families]
            archive = update_archive(archive, offspring, size)
        return join_evaluations(archive, problem)

    def _neighbours(self, population: int) -> list[list[int]]:
        """Indices of each cell and its neighbours, without repetition."""
        rows, columns = self.grid_sides(population)
        offsets = ((0, 0), *NEIGHBOURHOODS[self.neighbourhood])
        return [
            list(dict.fromkeys((row + down) % rows * columns + (column + right) % columns for down, right in offsets))
            for row in range(rows)
            for column in range(columns)
        ]


def choose_survivor(cell: Individual, child: Individual, mates: list[Individual]) -> Individual:
    """Choose between a cell and its evaluated child. `mates` are the cell and its neighbours; sets their `standing` if
    neither dominates.
    """
    if child.has_failed or (not cell.has_failed and cell.fitness.dominates(child.fitness)):
        return cell
    if cell.has_failed or child.fitness.dominates(cell.fitness):
        return child
    set_standings([*mates, child])
    return cell if all(mate.standing <= child.standing for mate in mates) else child


def update_archive(archive: list[Individual], offspring: list[Individual], size: int) -> list[Individual]:
    """Select the non-dominated individuals of archive and offspring, without duplicates, at most the `size` least
    crowded of them; sets their `standing`.

    The archive gets copies: archive and grid rank the same individual differently, and each writes its `standing`.
    """
    distinct = {individual.fitness.values: individual for individual in archive}
    for child in offspring:
        if not child.has_failed and child.fitness.values not in distinct:
            distinct[child.fitness.values] = copy(child)
    fronts = set_standings(list(distinct.values()))
    new_archive = fronts[0] if fronts else []
    while len(new_archive) > size:
        del new_archive[max(range(len(new_archive)), key=lambda i: new_archive[i].standing)]  # the most crowded
        set_standings(new_archive)
    return new_archive
