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
    result_of,
    simulated,
    stand_by_crowding,
)

Side = Annotated[int, Meta(ge=1, le=100_000)]
CROSS = ((-1, 0), (1, 0), (0, 1), (0, -1))
NEIGHBOURHOODS = {"von_neumann": CROSS, "moore": (*CROSS, (-1, 1), (-1, -1), (1, 1), (1, -1))}
"""Rows and columns from a cell to its neighbours: 4 or 8 of them."""


class MoCell(Operators, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cells on a toroidal grid that mate with their neighbours and with an archive of non-dominated individuals.

    All cells reproduce at once, from the grid as it was. A child takes its cell if it dominates what is there, or if neither does and it is
    not the worst of the neighbourhood. The variables are the characteristics' unfiltered values; what is simulated and reported is
    filtered. The result is the archive.

    Parameters
    ----------
    crossover_probability, crossover_index
        Of simulated binary crossover.
    mutation_probability, mutation_index
        Of polynomial mutation; by default the probability 1/n per variable.
    tournament_size
        Individuals of a tournament.
    archive
        Size of the archive, by default the population's; it is thinned by crowding distance.
    grid
        Rows and columns, together the population; by default as near to a square as it can be.
    neighbourhood
        The 4 (von_neumann) or 8 (moore) cells around a cell.
    """

    archive: Size | None = None
    grid: tuple[Side, Side] | None = None
    neighbourhood: Literal["moore", "von_neumann"] = "moore"

    def sides(self, population: int, source: str = "search.mocell") -> tuple[int, int]:
        """Rows and columns of the grid.

        Raises
        ------
        InputError
            If they do not make the population.
        """
        if self.grid is None:
            rows = next(side for side in range(math.isqrt(population), 0, -1) if population % side == 0)
            return rows, population // rows
        if math.prod(self.grid) != population:
            raise InputError(source, f"search.mocell.grid = {list(self.grid)} has {math.prod(self.grid)} cells",
                             f"two sides whose product is search.population = {population}")
        return self.grid

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        neighbours = self._neighbours(problem.population)
        variation, size = Variation(self, problem, rng), self.archive or problem.population
        cells = initial_population(problem, rng)
        asked = yield from simulated(cells, problem)
        archive = archived([], cells, size)
        while asked < problem.evaluations and archive:
            alive = [cell for cell in cells if not cell.failed]
            stand_by_crowding(alive)
            around = [[cells[i] for i in place if not cells[i].failed] for place in neighbours]
            with variation.randomness():
                offspring = [variation.child(mates or archive, archive) for mates in around[:problem.evaluations - asked]]
            asked += yield from simulated(offspring, problem)
            cells[:len(offspring)] = [replaced(cell, child, mates) for cell, child, mates in zip(cells, offspring, around, strict=False)]
            archive = archived(archive, offspring, size)
        return result_of(archive, problem)

    def _neighbours(self, population: int) -> list[list[int]]:
        """Each cell and those around it, once each."""
        rows, columns = self.sides(population)
        steps = ((0, 0), *NEIGHBOURHOODS[self.neighbourhood])
        return [list(dict.fromkeys((row + down) % rows * columns + (column + right) % columns for down, right in steps))
                for row in range(rows) for column in range(columns)]


def replaced(cell: Individual, child: Individual, mates: list[Individual]) -> Individual:
    """The individual in a cell after its child is evaluated; `mates` are the cell and its neighbours."""
    if child.failed or (not cell.failed and cell.fitness.dominates(child.fitness)):
        return cell
    if cell.failed or child.fitness.dominates(cell.fitness):
        return child
    stand_by_crowding([*mates, child])
    return cell if all(mate.standing <= child.standing for mate in mates) else child


def archived(archive: list[Individual], offspring: list[Individual], size: int) -> list[Individual]:
    """The non-dominated individuals of archive and offspring, equals once, without the most crowded; `standing` is by crowding distance.

    Offspring are copied into the archive: the same individual has another standing as a cell.
    """
    distinct = {one.fitness.values: one for one in archive}
    for child in offspring:
        if not child.failed and child.fitness.values not in distinct:
            distinct[child.fitness.values] = copy(child)
    left = next(iter(stand_by_crowding(list(distinct.values()))), [])
    while len(left) > size:
        del left[max(range(len(left)), key=lambda i: left[i].standing)]
        stand_by_crowding(left)
    return left
