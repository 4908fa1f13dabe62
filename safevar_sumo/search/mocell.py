"""MOCell (Nebro et al. 2009): a cellular genetic algorithm, here synchronous, so that a generation is one batch."""

from __future__ import annotations

import math
from copy import copy
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.search.evolution import (
    Individual,
    Operators,
    Size,
    Variation,
    initial_population,
    join_evaluations,
    request_evaluations,
    set_standings,
)

GridSide = Annotated[int, Meta(ge=1, le=100_000)]
CROSS = ((-1, 0), (1, 0), (0, 1), (0, -1))
NEIGHBOURHOODS = {"von_neumann": CROSS, "moore": (*CROSS, (-1, 1), (-1, -1), (1, 1), (1, -1))}
"""Offsets, in rows and columns, from a cell to its 4 or 8 neighbours."""


class MoCell(Operators, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cells on a toroidal grid that mate with their neighbours and with an archive of non-dominated individuals.

    All cells reproduce at once, from the previous grid. A child replaces its cell's individual if the child dominates
    that individual, or if neither dominates and the child is not the worst of the neighbourhood. The variables are the
    characteristics' unfiltered values; simulation and results use filtered ones. The result is the archive.

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
        variation, size = Variation(self, problem, rng), self.archive or problem.population
        cells = initial_population(problem, rng)
        used = yield from request_evaluations(cells, problem)
        archive = update_archive([], cells, size)
        while used < problem.evaluations and archive:
            valid = [cell for cell in cells if not cell.has_failed]
            set_standings(valid)
            neighbourhoods = [[cells[i] for i in indices if not cells[i].has_failed] for indices in neighbours]
            with variation.randomness():
                offspring = [
                    variation.draw_child(mates or archive, archive)
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
    """Choose between a cell and its evaluated child; `mates` are the cell and its neighbours, whose `standing` may
    change.
    """
    if child.has_failed or (not cell.has_failed and cell.fitness.dominates(child.fitness)):
        return cell
    if cell.has_failed or child.fitness.dominates(cell.fitness):
        return child
    set_standings([*mates, child])
    return cell if all(mate.standing <= child.standing for mate in mates) else child


def update_archive(archive: list[Individual], offspring: list[Individual], size: int) -> list[Individual]:
    """Select the at most `size` least crowded non-dominated individuals of archive and offspring, without duplicates;
    sets `standing`.

    Offspring are copied into the archive, because archive and grid each set the `standing` of their own copy.
    """
    distinct = {individual.fitness.values: individual for individual in archive}
    for child in offspring:
        if not child.has_failed and child.fitness.values not in distinct:
            distinct[child.fitness.values] = copy(child)
    new_archive = next(iter(set_standings(list(distinct.values()))), [])
    while len(new_archive) > size:
        del new_archive[max(range(len(new_archive)), key=lambda i: new_archive[i].standing)]
        set_standings(new_archive)
    return new_archive
