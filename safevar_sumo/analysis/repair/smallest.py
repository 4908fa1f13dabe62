"""The smallest change of some parameters that survives all known counterexamples.

Sets of parameters are dropped at their first failure, worst wear first: candidates are tried with single vehicles at
single points, and only the smallest that is left with the worst vehicles at all points. Either it fails at a vehicle,
with which all candidates are then tried, or it is the smallest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from safevar_sumo.analysis.evaluator import sobol_points
from safevar_sumo.analysis.repair.problem import Failure, Problem, degrees_of
from safevar_sumo.records import BoolArray, FloatArray

SOBOL_SETS, DIAGONAL_SETS, LINE_SETS = 4096, 256, 64
"""Sets of parameters in a subset's box, on each of its diagonals, and on a line back to the parameters of today."""
THINNING = 16
"""Factor by which an ADS has fewer sets that needs an own instance for each."""
MAX_ZOOMS, LEAST_GAIN = 8, 0.002
"""Boxes searched in turn, each as large as the smallest change so far; the search ends when a box gains less."""
FIRST_VEHICLES = 16
"""Vehicles with which a candidate is tried first; then with four times as many, and so on."""
WORST_VEHICLES = 80
"""Vehicles that a candidate survives before it counts as the smallest change; the result is tried with all."""
Subset = tuple[int, ...]
"""Columns of the parameters that change."""


class Search:
    """Searches the smallest changes that survive `vehicles`, shape (L, n), at the points `seen`, worst first.

    `failures` are single vehicles at single points that have told candidates apart.
    """

    def __init__(self, problem: Problem, vehicles: FloatArray, seen: Sequence[int]) -> None:
        self.problem, self.vehicles, self.seen = problem, vehicles, list(seen)
        self.failures: list[Failure] = []
        self._thinning = 1 if problem.takes_arrays else THINNING

    def add(self, vehicles: FloatArray) -> None:
        """Add counterexamples, which are tried first."""
        rows = np.concatenate([vehicles, self.vehicles])
        self.vehicles = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]

    def survivors(self, shares: FloatArray, most: int | None = None) -> list[Failure | None]:
        """The first failure of each of M sets of parameters, shape (M, P); None if it survives all vehicles, or the
        first `most`.
        """
        first: list[Failure | None] = [None] * len(shares)
        start, size, alive = 0, FIRST_VEHICLES, np.arange(len(shares))
        while start < len(self.vehicles[:most]) and len(alive):
            vehicles = self.vehicles[start : start + size]
            wear = np.tile(vehicles, (len(alive), 1))
            evaluations = self.problem.evaluate(
                np.repeat(shares[alive], len(vehicles), axis=0), wear, "candidates with all vehicles", self.seen
            )
            fails = (degrees_of(evaluations) < self.problem.margin).reshape(len(alive), -1)
            points = np.zeros(len(wear), dtype=int) if evaluations.worst_points is None else evaluations.worst_points
            for number, row in enumerate(alive.tolist()):
                if fails[number].any():
                    vehicle = int(np.argmax(fails[number]))
                    place = int(points[number * len(vehicles) + vehicle])
                    first[row] = Failure(vehicles[vehicle], self.seen[place] if self.seen else 0)
            alive = alive[~fails.any(axis=1)]
            start, size = start + size, 4 * size
        return first

    def least(self, groups: Sequence[FloatArray], costs: Sequence[FloatArray]) -> list[FloatArray | None]:
        """The candidate of least cost in each group, shape (M, P), that survives everything; None if none does."""
        owner = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        shares, cost = np.concatenate(groups), np.concatenate(costs)
        alive = np.ones(len(shares), dtype=bool)
        found: list[FloatArray | None] = [None] * len(groups)
        for failure in self.failures:
            self._drop(shares, alive, failure)
        open_groups = set(range(len(groups)))
        while open_groups:
            picks = {}
            for group in sorted(open_groups):
                rows = np.flatnonzero(alive & (owner == group))
                if len(rows):
                    picks[group] = int(rows[np.argmin(cost[rows])])
            open_groups &= picks.keys()
            if not picks:
                break
            new_failures = dict[bytes, Failure]()
            for group, first in zip(picks, self.survivors(shares[list(picks.values())], WORST_VEHICLES), strict=True):
                if first is None:
                    found[group] = shares[picks[group]]
                    open_groups.discard(group)
                    alive &= owner != group
                else:
                    alive[picks[group]] = False
                    new_failures[first.setting.tobytes() + bytes([first.point])] = first
            for failure in new_failures.values():
                self.failures.append(failure)
                self._drop(shares, alive, failure)
        return found

    def _drop(self, shares: FloatArray, alive: BoolArray, failure: Failure) -> None:
        """Drop the candidates that fail with a vehicle at a point."""
        rows = np.flatnonzero(alive)
        if len(rows):
            points = [failure.point] if self.seen else []
            wear = np.tile(failure.setting, (len(rows), 1))
            degrees = self.problem.degrees(shares[rows], wear, "candidates with single vehicles", points)
            alive[rows[degrees < self.problem.margin]] = False

    def smallest(
        self, subsets: Sequence[Subset], limits: Mapping[Subset, float], starts: Mapping[Subset, float]
    ) -> dict[Subset, FloatArray]:
        """The smallest change of each subset below a limit, if there is one; the first boxes have the size `starts`."""
        best = dict[Subset, FloatArray]()
        half = {subset: min(starts.get(subset, 1.0), limits[subset]) for subset in subsets}
        open_subsets = [subset for subset in subsets if limits[subset] > 0]
        for zoom in range(MAX_ZOOMS):
            if not open_subsets:
                break
            groups = [self._box(subset, half[subset], zoom) for subset in open_subsets]
            found = self.least(groups, [self.change(group) for group in groups])
            remaining = []
            for subset, candidate in zip(open_subsets, found, strict=True):
                if candidate is None:
                    if subset not in best and half[subset] < limits[subset]:
                        half[subset] = limits[subset]
                        remaining.append(subset)
                    continue
                best[subset], gain = candidate, half[subset] - float(self.change(candidate))
                half[subset] -= gain
                if gain > LEAST_GAIN and len(subset) > 1:
                    remaining.append(subset)
            open_subsets = remaining
        return self._shrunk(best)

    def change(self, shares: FloatArray) -> FloatArray:
        """The largest change of a parameter, as a share of its range; of the last axis."""
        return np.asarray(np.max(np.abs(shares - self.problem.today), axis=-1))

    def _box(self, subset: Subset, half: float, zoom: int) -> FloatArray:
        """Candidates in the box of a subset that goes `half` of the ranges from today, and on its diagonals."""
        today, columns = self.problem.today, list(subset)
        lower, upper = np.maximum(today - half, 0.0)[columns], np.minimum(today + half, 1.0)[columns]
        inner = lower + sobol_points(SOBOL_SETS // self._thinning, len(columns), zoom) * (upper - lower)
        steps = np.arange(self._thinning, DIAGONAL_SETS + 1, self._thinning) / DIAGONAL_SETS * half
        diagonals = [today[columns] + np.outer(steps, signs) for signs in product((-1.0, 1.0), repeat=len(columns))]
        points = np.concatenate([inner, np.clip(np.concatenate(diagonals), 0.0, 1.0)])
        shares = np.tile(today, (len(points), 1))
        shares[:, columns] = points
        return shares

    def _shrunk(self, best: Mapping[Subset, FloatArray]) -> dict[Subset, FloatArray]:
        """Changes moved back towards today: all together, then each by itself."""
        result = dict(best)
        self._move_back(result, {subset: subset for subset in result})
        for place in range(max(map(len, result), default=0)):
            self._move_back(result, {subset: (subset[place],) for subset in result if 1 < len(subset) > place})
        return result

    def _move_back(self, result: dict[Subset, FloatArray], columns: Mapping[Subset, Subset]) -> None:
        """Move some columns of each change towards today: on a grid, then between two of its points."""
        ends, low, high = dict(result), dict.fromkeys(columns, 0.0), dict.fromkeys(columns, 1.0)
        for _ in range(2 if columns else 0):
            steps = {
                subset: low[subset] + (high[subset] - low[subset]) * np.arange(1, LINE_SETS + 1) / LINE_SETS
                for subset in columns
            }
            lines = []
            for subset, moved in columns.items():
                line = np.tile(ends[subset], (LINE_SETS, 1))
                start, end = self.problem.today[list(moved)], ends[subset][list(moved)]
                line[:, list(moved)] = start + steps[subset][:, np.newaxis] * (end - start)
                line[-1] = result[subset]
                lines.append(line)
            for subset, line, one in zip(columns, lines, self.least(lines, list(steps.values())), strict=True):
                if one is not None:
                    index = int(np.flatnonzero((line == one).all(axis=1))[0])
                    low[subset], high[subset] = steps[subset][index - 1] if index else low[subset], steps[subset][index]
                    result[subset] = one
