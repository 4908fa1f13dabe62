"""The smallest changes of the parameters that survive all known counterexamples (step 2 of a repair).

A change is a set of parameters; candidates for a change are dropped at their first failure. All candidates are tried
with few vehicles at single points. Only the smallest of those that survive is tried with the worst vehicles at all
points. Either it fails with a vehicle, with which all candidates are then tried, or it is the smallest change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import moocore
import numpy as np
import numpy.typing as npt

from safevar_sumo.analysis.evaluator import sobol_points
from safevar_sumo.analysis.repair.problem import RepairProblem
from safevar_sumo.records import FloatArray

MOST_CHANGED, MOST_REPAIRS = 3, 4
"""Largest number of parameters that change together, unless none so small survives; largest number of repairs."""
SOBOL_SETS, DIAGONAL_SETS, LINE_SETS = 4096, 256, 64
"""Number of candidates in a subset's box, on each of its diagonals, and on a line back to the parameters of today."""
THINNING = 16
"""Factor by which an ADS that needs an instance for each set of parameters has fewer candidates."""
CHUNK, BATCH = 512, 2048
"""Number of candidates of a subset that are tried at a time, the smallest changes first; of simulations in a batch."""
MAX_BOXES, LEAST_GAIN = 12, 0.006
"""Number of boxes that are searched in turn, each smaller than the smallest change so far by the least gain that
counts, a share of the ranges.
"""
EARLIER_BOX = 0.05
"""After a change has failed, the first box in which it is sought again is larger by this share of the ranges."""
FIRST_VEHICLES, WORST_VEHICLES = 16, 80
"""Number of vehicles with which a candidate is tried first, at least, then with four times as many, and so on; and of
those that it survives before it counts as the smallest change. The Pareto set is tried with all.
"""
GENERATIONS = 60
"""Generations of CMA-ES."""
Subset = tuple[int, ...]
"""Columns of the parameters that change."""


class Failure(NamedTuple):
    """A vehicle, shape (w,), and the point at which a candidate failed with it; `points` is empty without a matrix."""

    vehicle: FloatArray
    points: tuple[int, ...]


class Search:
    """Searches the smallest changes that survive `vehicles`, shape (L, w), worst first, at the points `seen`.

    `best` holds the smallest change of each subset that has one. Counterexamples only make the smallest change of a
    subset larger. So `best`, and `_bounds` where a subset has none, are lower bounds even if they are older than some
    counterexamples, and only what may be part of the answer has to be searched again.
    """

    def __init__(self, problem: RepairProblem, vehicles: FloatArray, seen: Sequence[int]) -> None:
        self.problem, self.vehicles, self.seen = problem, vehicles, list(seen)
        self.best = dict[Subset, FloatArray]()
        self._bounds = dict[Subset, float]()
        self._failures = list[Failure]()
        self._thinning = 1 if problem.arrays else THINNING

    def add(self, vehicles: FloatArray) -> None:
        """Add counterexamples, which are tried first."""
        rows = np.concatenate([vehicles, self.vehicles])
        self.vehicles = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]

    def largest_change(self, shares: FloatArray) -> FloatArray:
        """The largest change of a parameter in each set, shape (..., P), as a share of its range."""
        return np.asarray(np.max(np.abs(shares - self.problem.today), axis=-1))

    def pareto_set(self, price: Callable[[FloatArray], float]) -> list[FloatArray]:
        """The changes that survive all counterexamples and are best in their number of parameters, largest change or
        price: their Pareto set, or its first `MOST_REPAIRS`.
        """
        while True:
            self._search_subsets()
            if not self.best:
                return []
            subsets = list(self.best)
            rows = [
                (len(subset), float(self.largest_change(change)), price(change)) for subset, change in self.best.items()
            ]
            is_best = moocore.is_nondominated(np.array(rows))
            chosen = [subsets[row] for row in sorted(np.flatnonzero(is_best), key=rows.__getitem__)[:MOST_REPAIRS]]
            changes = [self.best[subset] for subset in chosen]
            failures = self.first_failures(np.array(changes))
            if not any(failures):
                return changes
            for subset, failure in zip(chosen, failures, strict=True):
                if failure is not None:
                    self._failures.insert(0, failure)
                    del self.best[subset]

    def _search_subsets(self) -> None:
        """Search the subsets of 1, 2, 3 parameters that may have a smaller change than subsets of them.

        The search ends one parameter after the first number with a change; without any change, all parameters change
        together.
        """
        count = len(self.problem.parameters)
        for size in range(1, min(MOST_CHANGED, count) + 1):
            limits = {}
            for subset in combinations(range(count), size):
                inner = [change for other, change in self.best.items() if set(other) < set(subset)]
                limit = min([1.0, *(float(self.largest_change(change)) - LEAST_GAIN for change in inner)])
                if subset not in self.best and self._bounds.get(subset, 0.0) < limit:
                    limits[subset] = limit
            self.search(limits)
            if any(len(subset) < size for subset in self.best):
                return
        if not self.best and count > MOST_CHANGED:
            everything = tuple(range(count))
            candidate = self._by_cma_es()
            if candidate is not None:
                self.best[everything] = candidate
                self._shrink([everything])

    def search(self, limits: Mapping[Subset, float]) -> None:
        """Find the smallest change of each subset below its limit, if there is one; none lies below its bound.

        A subset that has been searched before first has a box just beyond its bound, and the whole box if it fails.
        """
        bounds = {subset: self._bounds.get(subset, 0.0) for subset in limits}
        half_widths = {
            subset: min(limit, bounds[subset] + EARLIER_BOX) if bounds[subset] else limit
            for subset, limit in limits.items()
        }
        open_subsets = list(limits)
        for number in range(MAX_BOXES):
            if not open_subsets:
                break
            boxes = []
            for subset in open_subsets:
                box = self._box(subset, half_widths[subset], number)
                boxes.append(box[self.largest_change(box) >= bounds[subset]])
            better = {
                subset: box[row]
                for subset, box, row in zip(open_subsets, boxes, self._smallest(boxes), strict=True)
                if row is not None
            }
            self.best |= better
            self._shrink(list(better))
            wider = [
                subset for subset in open_subsets if subset not in self.best and half_widths[subset] < limits[subset]
            ]
            half_widths |= {subset: limits[subset] for subset in wider}
            half_widths |= {subset: float(self.largest_change(self.best[subset])) - LEAST_GAIN for subset in better}
            # A single parameter has been moved back as far as it goes.
            narrower = [subset for subset in better if len(subset) > 1 and half_widths[subset] > bounds[subset]]
            open_subsets = wider + narrower
        for subset, limit in limits.items():
            self._bounds[subset] = float(self.largest_change(self.best[subset])) if subset in self.best else limit

    def first_failures(self, shares: FloatArray, most: int | None = None) -> list[Failure | None]:
        """The first failure of each of M sets of parameters, shape (M, P); None for a set that survives all vehicles,
        or the first `most`.
        """
        failures: list[Failure | None] = [None] * len(shares)
        start, alive = 0, np.arange(len(shares))
        size = max(FIRST_VEHICLES, CHUNK // max(len(shares) * len(self.seen), 1))
        while start < len(self.vehicles[:most]) and len(alive):
            vehicles = self.vehicles[start : start + size]
            degrees, points = self.problem.degrees(shares[alive], vehicles, "candidates with all vehicles", self.seen)
            fails = degrees < self.problem.margin
            for number in np.flatnonzero(fails.any(axis=1)).tolist():
                vehicle = int(np.argmax(fails[number]))
                failed_points = (self.seen[points[number, vehicle]],) if self.seen else ()
                failures[alive[number]] = Failure(vehicles[vehicle], failed_points)
            alive = alive[~fails.any(axis=1)]
            start, size = start + size, 4 * size
        return failures

    def _smallest(self, groups: Sequence[FloatArray]) -> list[int | None]:
        """For each group of candidates, shape (M, P), the smallest first: the first row that survives; None if none
        does.
        """
        rows: list[int | None] = [None] * len(groups)
        for start in range(0, max(map(len, groups), default=0), CHUNK):
            parts = {
                number: group[start : start + CHUNK] for number, group in enumerate(groups) if rows[number] is None
            }
            if not parts:
                break
            shares = np.concatenate(list(parts.values()))
            group_of = np.repeat(list(parts), list(map(len, parts.values())))
            row_of = np.concatenate([start + np.arange(len(part)) for part in parts.values()])
            new_failures = self._failures
            while True:
                survivors = self._survivors(shares, new_failures)
                shares, group_of, row_of = shares[survivors], group_of[survivors], row_of[survivors]
                if not len(shares):
                    break
                picks = np.unique(group_of, return_index=True)[1]  # the smallest of each group
                failures = self.first_failures(shares[picks], WORST_VEHICLES)
                for pick, failure in zip(picks, failures, strict=True):
                    if failure is None:
                        rows[group_of[pick]] = int(row_of[pick])
                is_open = np.array([rows[number] is None for number in group_of])
                is_open[picks] = False
                shares, group_of, row_of = shares[is_open], group_of[is_open], row_of[is_open]
                distinct = {(failure.vehicle.tobytes(), failure.points): failure for failure in failures if failure}
                new_failures = list(distinct.values())
                self._failures = new_failures + self._failures
        return rows

    def _survivors(self, shares: FloatArray, failures: Sequence[Failure]) -> npt.NDArray[np.intp]:
        """The rows of the candidates that survive the vehicles of failures at their points; few at a time."""
        alive = np.arange(len(shares))
        for points in dict.fromkeys(failure.points for failure in failures):
            vehicles = np.array([failure.vehicle for failure in failures if failure.points == points])
            while len(vehicles) and len(alive):
                number = max(1, BATCH // len(alive))
                stage = "candidates with single vehicles"
                degrees, _ = self.problem.degrees(shares[alive], vehicles[:number], stage, points)
                alive, vehicles = alive[(degrees >= self.problem.margin).all(axis=1)], vehicles[number:]
        return alive

    def _box(self, subset: Subset, half_width: float, number: int) -> FloatArray:
        """Candidates in a subset's box around today's parameters, and on its diagonals; the smallest changes first.

        `half_width` is a share of the ranges; the box with another `number` has other points.
        """
        today, columns = self.problem.today, list(subset)
        lower, upper = np.maximum(today - half_width, 0.0)[columns], np.minimum(today + half_width, 1.0)[columns]
        inner = lower + sobol_points(SOBOL_SETS // self._thinning, len(columns), number) * (upper - lower)
        steps = np.arange(self._thinning, DIAGONAL_SETS + 1, self._thinning) / DIAGONAL_SETS * half_width
        diagonals = [today[columns] + np.outer(steps, signs) for signs in product((-1.0, 1.0), repeat=len(columns))]
        points = np.concatenate([inner, np.clip(np.concatenate(diagonals), 0.0, 1.0)])
        shares = np.tile(today, (len(points), 1))
        shares[:, columns] = points
        return shares[np.argsort(self.largest_change(shares), kind="stable")]

    def _shrink(self, subsets: Sequence[Subset]) -> None:
        """Move the best changes of subsets back towards today: all parameters together, then each alone."""
        self._move_back({subset: list(subset) for subset in subsets})
        for place in range(max(map(len, subsets), default=0)):
            self._move_back({subset: [subset[place]] for subset in subsets if len(subset) > max(place, 1)})

    def _move_back(self, columns: Mapping[Subset, list[int]]) -> None:
        """Move some columns of the best changes of subsets towards today: on a grid, then between two of its points."""
        today, ends = self.problem.today, [self.best[subset] for subset in columns]
        low, high = np.zeros(len(columns)), np.ones(len(columns))
        for _ in range(2):
            steps = low[:, np.newaxis] + np.outer(high - low, np.arange(1, LINE_SETS + 1) / LINE_SETS)
            lines = [np.tile(end, (LINE_SETS, 1)) for end in ends]
            for (subset, moved), line, step, end in zip(columns.items(), lines, steps, ends, strict=True):
                line[:, moved] = today[moved] + np.outer(step, end[moved] - today[moved])
                line[-1] = self.best[subset]
            for number, (subset, row) in enumerate(zip(columns, self._smallest(lines), strict=True)):
                if row is not None:
                    self.best[subset], high[number] = lines[number][row], steps[number][row]
                    if row:
                        low[number] = steps[number][row - 1]

    def _by_cma_es(self) -> FloatArray | None:
        """A small change of all parameters together that survives all counterexamples, by CMA-ES.

        A set that some of the worst vehicles do not survive is worse than any change; the less margin it lacks, the
        better.
        """
        import cma  # slow to import

        options = {"bounds": [0, 1], "seed": self.problem.study.search.seed % 2**31 + 1, "verbose": -9}
        strategy = cma.CMAEvolutionStrategy(np.clip(self.problem.today, 0.1, 0.9), 0.3, options)
        best: FloatArray | None = None
        for _ in range(GENERATIONS):
            shares = np.clip(np.array(strategy.ask()), 0.0, 1.0)
            vehicles = self.vehicles[:FIRST_VEHICLES]
            degrees, _ = self.problem.degrees(shares, vehicles, "all parameters together", self.seen)
            lack = np.clip(self.problem.margin - degrees.min(axis=1), 0.0, 100.0)
            changes = self.largest_change(shares)
            for row in np.argsort(changes, kind="stable"):
                if lack[row] == 0 and (best is None or changes[row] < self.largest_change(best)):
                    (failure,) = self.first_failures(shares[[row]])
                    if failure is None:
                        best = shares[row]
                        break
                    self.add(failure.vehicle[np.newaxis])
            strategy.tell(list(shares), np.where(lack > 0, 1 + lack, changes).tolist())
        return best
