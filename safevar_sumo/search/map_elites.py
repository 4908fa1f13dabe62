"""MAP-Elites (Mouret and Clune 2015) on pyribs: an atlas of failures, the one with the smallest changes
in each cell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, IntArray
from safevar_sumo.search.base import Algorithm, Problem, Search
from safevar_sumo.search.evolution import Probability, TournamentSize

if TYPE_CHECKING:
    from ribs.archives import GridArchive

MAX_CELLS = 2**16
"""Maximum number of cells of an atlas: with more than 16 characteristics, not every set of changes can be a cell."""
FASTEST_COLLISION = 20.0
"""Collision speed up to which the cells are equally wide [m/s]; the last cell holds faster collisions, too."""

QUALITY_OFFSET = 1e6
"""A number larger than any objective, which makes a collision better than any setting without a collision."""


class MapElites(Algorithm, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An atlas of distinct failures, an elite for every cell; needs the extra `qd`.

    The elite of a cell is the collision whose largest change is smallest or, without a collision, the most severe
    setting. A child has an elite's changes: one may be removed, one added; the others mutate. The result is all elites
    that collide or, if none collides, the elites that are more severe than the original.

    Parameters
    ----------
    behaviour
        Definition of a cell: the set of characteristics changed (changes), or the number of changes and the speed of
        the collision (speed).
    added, removed
        Probability that a child changes a further characteristic, and probability that it removes a change.
    reach
        Standard deviation of the mutation of changed values [share of the domain].
    speeds
        Number of intervals of the collision speed, each a cell; one more cell holds settings without a collision.
    tournament_size
        Number of elites in the tournament for a parent.
    """

    behaviour: Literal["changes", "speed"] = "changes"
    added: Probability = 0.4
    removed: Probability = 0.4
    reach: Annotated[float, Meta(gt=0, le=1)] = 0.15
    speeds: Annotated[int, Meta(ge=1, le=100)] = 20
    tournament_size: TournamentSize = 6

    def count_cells(self, characteristic_count: int, source: str = "search.map_elites") -> int:
        """The number of cells of an atlas; also checks that pyribs, which makes it, is installed.

        Raises
        ------
        InputError
            If there are too many cells, or pyribs is not installed.
        """
        cell_count = (
            2**characteristic_count if self.behaviour == "changes" else characteristic_count * (self.speeds + 1)
        )
        if cell_count > MAX_CELLS:
            raise InputError(
                source, f"search.map_elites.behaviour = 'changes' has 2^{characteristic_count} cells", "'speed'"
            )
        try:
            import ribs  # noqa: F401
        except ImportError:
            raise InputError(
                source,
                "search.algorithms = 'map_elites' needs pyribs, which is not installed",
                "in the checkout: pip install '.[qd]'",
            ) from None
        return cell_count

    def search(self, problem: Problem, rng: np.random.Generator) -> Search:
        cell_count = self.count_cells(len(problem.characteristics))
        from ribs.archives import GridArchive  # takes a second to load

        # What the archive stores of a setting is the number of its evaluation.
        archive = GridArchive(solution_dim=1, dims=[cell_count], ranges=[(-0.5, cell_count - 0.5)])
        batches, settings, used = list[Evaluations](), np.zeros((problem.evaluations, len(problem.characteristics))), 0
        quality = np.full(problem.evaluations, -np.inf)
        while used < problem.evaluations:
            elites = _elites_in(archive)
            parents = settings[self._draw_parents(elites, quality, problem.population, rng)] if len(elites) else None
            # A whole generation is drawn, so that a run does not depend on its budget:
            children = self._draw_children(parents, problem.population, problem, rng)
            evaluated = yield problem.characteristics.filter(children[: problem.evaluations - used])
            batches.append(evaluated)
            settings[used : used + len(evaluated)] = evaluated.settings
            is_valid = problem.scoring.valid(evaluated)
            valid, numbers = evaluated.take(is_valid), used + np.flatnonzero(is_valid)
            if len(valid):
                # Collisions by their largest change; other settings, all worse, by the first objective:
                severity = -problem.scoring.values(valid)[:, 0]
                quality[numbers] = np.where(valid.collided, QUALITY_OFFSET - valid.f_diff, severity)
                cells = self._cell_numbers(valid, problem)[:, np.newaxis]
                archive.add(numbers[:, np.newaxis].astype(float), quality[numbers], cells)
            used += len(evaluated)
        evaluations = Evaluations.concatenate(batches)
        atlas = evaluations.take(_elites_in(archive))
        is_more_severe = problem.scoring.values(atlas)[:, 0] < problem.scoring.values(problem.original)[0, 0]
        return atlas.take(atlas.collided if atlas.collided.any() else is_more_severe)

    def _draw_parents(self, elites: IntArray, quality: FloatArray, number: int, rng: np.random.Generator) -> IntArray:
        """`number` parents, each the best of `tournament_size` elites drawn at random."""
        candidates = rng.choice(elites, (number, self.tournament_size))
        return np.asarray(candidates[np.arange(number), np.argmax(quality[candidates], axis=1)])

    def _draw_children(
        self, parents: FloatArray | None, number: int, problem: Problem, rng: np.random.Generator
    ) -> FloatArray:
        """`number` children, not yet filtered, but feasible once they are; without parents, each has random changes."""
        characteristics = problem.characteristics
        size, width = len(characteristics), characteristics.upper - characteristics.lower
        if parents is None:
            is_changed = rng.random((number, size)) < rng.integers(1, size + 1, (number, 1)) / size
            return problem.repaired(np.where(is_changed, problem.uniform(number, rng), characteristics.original))
        changed = characteristics.changed(parents)
        mutated_values = parents + rng.normal(0, self.reach, parents.shape) * width
        children = np.where(changed, np.clip(mutated_values, characteristics.lower, characteristics.upper), parents)
        new_values = rng.uniform(characteristics.lower, characteristics.upper, parents.shape)
        added_columns = rng.integers(0, size, number)
        added_rows = np.flatnonzero(rng.random(number) < self.added)
        children[added_rows, added_columns[added_rows]] = new_values[added_rows, added_columns[added_rows]]
        # One of the parent's changes, each as likely as the others:
        removed_columns = np.argmax(np.where(changed, rng.random(parents.shape), -1.0), axis=1)
        removed_rows = np.flatnonzero(rng.random(number) < self.removed)
        children[removed_rows, removed_columns[removed_rows]] = characteristics.original[removed_columns[removed_rows]]
        return problem.repaired(children)

    def _cell_numbers(self, evaluated: Evaluations, problem: Problem) -> IntArray:
        changed = problem.characteristics.changed(evaluated.settings)
        if self.behaviour == "changes":
            return np.asarray(changed @ (1 << np.arange(changed.shape[1])))  # a bit for each characteristic
        speed = evaluated.collision_speed
        interval = np.minimum(np.floor(np.maximum(speed, 0) / FASTEST_COLLISION * self.speeds), self.speeds - 1)
        column = np.where(np.isnan(speed), 0, 1 + interval).astype(int)
        row = np.maximum(changed.sum(axis=1) - 1, 0)
        return np.asarray(row * (self.speeds + 1) + column)


def _elites_in(archive: GridArchive) -> IntArray:
    """The numbers of the evaluations that an archive stores, in order."""
    return np.sort(archive.data("solution")[:, 0]).astype(int) if len(archive) else np.zeros(0, dtype=int)
