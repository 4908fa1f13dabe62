"""MAP-Elites (Mouret and Clune 2015) on pyribs: an atlas with the failure of the smallest changes in every cell."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, IntArray
from safevar_sumo.search.base import Problem, Search
from safevar_sumo.search.evolution import Probability, TournamentSize

MOST_CELLS = 2**16
"""Maximum number of cells of an atlas: with more than 16 characteristics, not every set of changes can be a cell."""
FASTEST = 20.0
"""Speed of a collision up to which the cells are equally wide; faster ones are in the last cell, too [m/s]."""

NEVER_REACHED = 1e6
"""Larger than any objective."""


class MapElites(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An atlas of distinct failures, an elite for every cell; needs the extra `qd`.

    The elite of a cell is the collision whose largest change is smallest or, without a collision, the most severe setting. A child has an
    elite's changes: one may be removed or added, the others are moved. The result is all elites that collide or, if none collides, the
    elites that are more severe than the original.

    Parameters
    ----------
    behaviour
        Definition of a cell: the set of characteristics changed (changes), or the number of changes and the speed of the collision (speed).
    added, removed
        Probabilities that a child changes a further characteristic, and that it removes a change.
    reach
        Standard deviation of the mutation of changed values [share of the domain].
    speeds
        Number of cells over the speed of a collision; one more cell holds settings without a collision.
    tournament_size
        Number of elites in the tournament for a parent.
    """

    behaviour: Literal["changes", "speed"] = "changes"
    added: Probability = 0.4
    removed: Probability = 0.4
    reach: Annotated[float, Meta(gt=0, le=1)] = 0.15
    speeds: Annotated[int, Meta(ge=1, le=100)] = 20
    tournament_size: TournamentSize = 6

    def cells(self, characteristics: int, source: str = "search.map_elites") -> int:
        """Number of cells.

        Raises
        ------
        InputError
            If there are too many cells, or pyribs is not installed.
        """
        number = 2**characteristics if self.behaviour == "changes" else characteristics * (self.speeds + 1)
        if number > MOST_CELLS:
            raise InputError(source, f"search.map_elites.behaviour = 'changes' has 2^{characteristics} cells", "'speed'")
        try:
            import ribs  # noqa: F401
        except ImportError:
            raise InputError(source, "search.algorithms = 'map_elites' needs pyribs, which is not installed",
                             "pip install 'safevar_sumo[qd]'") from None
        return number

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        cell_count = self.cells(len(problem.characteristics))
        from ribs.archives import GridArchive  # takes a second to load

        archive = GridArchive(solution_dim=1, dims=[cell_count], ranges=[(-0.5, cell_count - 0.5)])
        batches, settings, used = list[Evaluations](), np.zeros((problem.evaluations, len(problem.characteristics))), 0
        quality = np.full(problem.evaluations, -np.inf)
        while used < problem.evaluations:
            number, generation = min(problem.population, problem.evaluations - used), problem.population
            elites = np.sort(archive.data("solution")[:, 0]).astype(int) if len(archive) else np.zeros(0, dtype=int)
            parents = settings[self._chosen(elites, quality, generation, rng)] if len(elites) else None
            children = self._children(parents, generation, problem, rng)  # all, so that a run does not depend on its budget
            evaluated = yield problem.characteristics.filter(children[:number])
            batches.append(evaluated)
            settings[used:used + number] = evaluated.settings
            valid = np.flatnonzero(problem.scoring.valid(evaluated))
            if len(valid):
                quality[used + valid] = _quality(evaluated, problem)[valid]
                cells = self._cell(evaluated, problem)[valid, np.newaxis]
                archive.add((used + valid)[:, np.newaxis].astype(float), quality[used + valid], cells)
            used += number
        everything = Evaluations.concatenate(batches)
        rows = np.sort(archive.data("solution")[:, 0]).astype(int) if len(archive) else np.zeros(0, dtype=int)
        atlas = everything.take(rows)
        better = problem.scoring.values(atlas)[:, 0] < problem.scoring.values(problem.original)[0, 0]
        return atlas.take(atlas.collided if atlas.collided.any() else better)

    def _chosen(self, elites: IntArray, quality: FloatArray, number: int, rng: np.random.Generator) -> IntArray:
        """`number` parents, each the best of `tournament_size` elites drawn at random."""
        candidates = rng.choice(elites, (number, self.tournament_size))
        return np.asarray(candidates[np.arange(number), np.argmax(quality[candidates], axis=1)])

    def _children(self, parents: FloatArray | None, number: int, problem: Problem, rng: np.random.Generator) -> FloatArray:
        """Unfiltered settings, feasible after the filter; without parents, each has some random changes."""
        members = problem.characteristics
        size, width = len(members), members.upper - members.lower
        if parents is None:
            changes = rng.random((number, size)) < rng.integers(1, size + 1, (number, 1)) / size
            return problem.repaired(np.where(changes, problem.uniform(number, rng), members.original))
        changed = members.changed(parents)
        moved = parents + rng.normal(0, self.reach, parents.shape) * width
        children = np.where(changed, np.clip(moved, members.lower, members.upper), parents)
        fresh = rng.uniform(members.lower, members.upper, parents.shape)
        for probability, values in ((self.added, fresh), (self.removed, np.broadcast_to(members.original, parents.shape))):
            at = rng.integers(0, size, number) if values is fresh else np.argmax(np.where(changed, rng.random(parents.shape), -1.0), axis=1)
            rows = np.flatnonzero(rng.random(number) < probability)
            children[rows, at[rows]] = values[rows, at[rows]]
        return problem.repaired(children)

    def _cell(self, evaluated: Evaluations, problem: Problem) -> IntArray:
        changed = problem.characteristics.changed(evaluated.settings)
        if self.behaviour == "changes":
            return np.asarray(changed @ (1 << np.arange(changed.shape[1])))
        speed = np.nan_to_num(evaluated.collision_speed, nan=-1.0)
        place = np.where(speed < 0, 0, 1 + np.minimum(np.floor(np.maximum(speed, 0) / FASTEST * self.speeds), self.speeds - 1))
        number = np.maximum(changed.sum(axis=1) - 1, 0)
        return np.asarray(number * (self.speeds + 1) + place.astype(int))


def _quality(evaluated: Evaluations, problem: Problem) -> FloatArray:
    """More is better: collisions by a small largest change; other settings, always worse, by a small first objective; shape (M,)."""
    return np.where(evaluated.collided, NEVER_REACHED - evaluated.f_diff, -problem.scoring.values(evaluated)[:, 0])
