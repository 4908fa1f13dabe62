"""The smallest changes of the parameters that survive all known counterexamples (step 2 of a repair).

Sets of parameters are dropped at their first failure, worst wear first: candidates are tried with single vehicles at
single points, and only the smallest that is left with the worst vehicles at all points. Either it fails at a vehicle,
with which all candidates are then tried, or it is the smallest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, product
from typing import NamedTuple

import moocore
import numpy as np
import numpy.typing as npt

from safevar_sumo.analysis.evaluator import sobol_points
from safevar_sumo.analysis.repair.problem import Problem
from safevar_sumo.records import FloatArray

MOST_CHANGED, MOST_KEPT = 3, 4
"""Largest number of parameters changed, unless nothing up to it survives; largest number of repairs."""
SOBOL_SETS, DIAGONAL_SETS, LINE_SETS = 4096, 256, 64
"""Sets of parameters in a subset's box, on each of its diagonals, and on a line back to the parameters of today."""
THINNING = 16
"""Factor by which an ADS has fewer sets that needs an own instance for each."""
CHUNK, BATCH = 512, 2048
"""Candidates of a subset that are tried at a time, the smallest changes first; candidates times vehicles of a batch."""
MAX_BOXES, LEAST_GAIN = 12, 0.006
"""Boxes that are searched in turn, each smaller than the smallest change so far by the least gain that counts."""
EARLIER_BOX = 0.05
"""A change that failed is sought again in a box that is larger by this share of the ranges."""
FIRST_VEHICLES, WORST_VEHICLES = 16, 80
"""Vehicles with which a candidate is tried first, at least, then with four times as many, and so on; and those that it
survives before it counts as the smallest change. The result is tried with all.
"""
GENERATIONS = 60
"""Generations of CMA-ES."""
Subset = tuple[int, ...]
"""Columns of the parameters that change."""


class Failure(NamedTuple):
    """A vehicle, shape (w,), at a point that told candidates apart; `points` is empty without a matrix."""

    vehicle: FloatArray
    points: tuple[int, ...]


class Search:
    """Searches the smallest changes that survive `vehicles`, shape (L, w), at the points `seen`, worst first.

    Counterexamples only make the smallest change of a subset larger. So the changes in `best`, and `bounds` where a
    subset has none, are lower bounds even if they are older than some counterexamples, and only what may be part of the
    answer has to be searched again.
    """

    def __init__(self, problem: Problem, vehicles: FloatArray, seen: Sequence[int]) -> None:
        self.problem, self.vehicles, self.seen = problem, vehicles, list(seen)
        self.best = dict[Subset, FloatArray]()
        self._bounds = dict[Subset, float]()
        self._failures = list[Failure]()
        self._thinning = 1 if problem.arrays else THINNING

    def add(self, vehicles: FloatArray) -> None:
        """Add counterexamples, which are tried first."""
        rows = np.concatenate([vehicles, self.vehicles])
        self.vehicles = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]

    def change(self, shares: FloatArray) -> FloatArray:
        """The largest change of a parameter, as a share of its range; of the last axis."""
        return np.asarray(np.max(np.abs(shares - self.problem.today), axis=-1))

    def pareto_set(self, price: Callable[[FloatArray], float]) -> list[FloatArray]:
        """The Pareto set of the number of changes, the largest change and the price; the smallest `MOST_KEPT` of it. It
        survives all counterexamples.
        """
        while True:
            self._search_subsets()
            if not self.best:
                return []
            subsets = list(self.best)
            rows = [(len(subset), float(self.change(one)), price(one)) for subset, one in self.best.items()]
            is_best = moocore.is_nondominated(np.array(rows))
            kept = [subsets[row] for row in sorted(np.flatnonzero(is_best), key=rows.__getitem__)[:MOST_KEPT]]
            failures = self.first_failures(np.array([self.best[subset] for subset in kept]))
            if not any(failures):
                return [self.best[subset] for subset in kept]
            for subset, failure in zip(kept, failures, strict=True):
                if failure is not None:
                    self._failures.insert(0, failure)
                    del self.best[subset]

    def _search_subsets(self) -> None:
        """Search the subsets of 1, 2, 3 parameters that may have a smaller change than smaller subsets, up to one more
        than the first number that works; if none does, all parameters together.
        """
        count = len(self.problem.parameters)
        for size in range(1, min(MOST_CHANGED, count) + 1):
            limits = {}
            for subset in combinations(range(count), size):
                inner = [float(self.change(one)) for key, one in self.best.items() if set(key) < set(subset)]
                limit = min([1.0, *(change - LEAST_GAIN for change in inner)])
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
        """Find the smallest change below a limit of each subset, if there is one; none lies below its bound."""
        bounds = {subset: self._bounds.get(subset, 0.0) for subset in limits}
        half = {one: min(limit, bounds[one] + EARLIER_BOX) if bounds[one] else limit for one, limit in limits.items()}
        open_subsets = list(limits)
        for number in range(MAX_BOXES):
            if not open_subsets:
                break
            boxes = [self._box(subset, half[subset], number) for subset in open_subsets]
            boxes = [box[self.change(box) >= bounds[subset]] for box, subset in zip(boxes, open_subsets, strict=True)]
            better = {
                subset: box[row]
                for subset, box, row in zip(open_subsets, boxes, self._least(boxes), strict=True)
                if row is not None
            }
            self.best |= better
            self._shrink(list(better))
            wider = [one for one in open_subsets if one not in self.best and half[one] < limits[one]]
            half |= {one: limits[one] for one in wider}
            half |= {subset: float(self.change(self.best[subset])) - LEAST_GAIN for subset in better}
            open_subsets = [*wider, *(one for one in better if len(one) > 1 and half[one] > bounds[one])]
        found = {one: float(self.change(self.best[one])) for one in limits if one in self.best}
        self._bounds |= {**limits, **found}

    def first_failures(self, shares: FloatArray, most: int | None = None) -> list[Failure | None]:
        """The first failure of each of M sets of parameters, shape (M, P); None if it survives all vehicles, or the
        first `most`.
        """
        first: list[Failure | None] = [None] * len(shares)
        start, alive = 0, np.arange(len(shares))
        size = max(FIRST_VEHICLES, CHUNK // max(len(shares) * len(self.seen), 1))
        while start < len(self.vehicles[:most]) and len(alive):
            vehicles = self.vehicles[start : start + size]
            degrees, points = self.problem.degrees(shares[alive], vehicles, "candidates with all vehicles", self.seen)
            fails = degrees < self.problem.margin
            for number in np.flatnonzero(fails.any(axis=1)).tolist():
                vehicle = int(np.argmax(fails[number]))
                place = (self.seen[points[number, vehicle]],) if self.seen else ()
                first[alive[number]] = Failure(vehicles[vehicle], place)
            alive = alive[~fails.any(axis=1)]
            start, size = start + size, 4 * size
        return first

    def _least(self, groups: Sequence[FloatArray]) -> list[int | None]:
        """The first row of each group of candidates, shape (M, P), that survives everything; None if none does."""
        found: list[int | None] = [None] * len(groups)
        for start in range(0, max(map(len, groups), default=0), CHUNK):
            parts = {
                number: group[start : start + CHUNK] for number, group in enumerate(groups) if found[number] is None
            }
            if not parts:
                break
            shares = np.concatenate(list(parts.values()))
            group_of = np.repeat(list(parts), list(map(len, parts.values())))
            row_of = np.concatenate([start + np.arange(len(part)) for part in parts.values()])
            failures = self._failures
            while True:
                left = self._survivors(shares, failures)
                shares, group_of, row_of = shares[left], group_of[left], row_of[left]
                if not len(shares):
                    break
                picks = np.unique(group_of, return_index=True)[1]
                first = self.first_failures(shares[picks], WORST_VEHICLES)
                for pick, failure in zip(picks, first, strict=True):
                    if failure is None:
                        found[group_of[pick]] = int(row_of[pick])
                is_left = np.array([found[number] is None for number in group_of])
                is_left[picks] = False
                shares, group_of, row_of = shares[is_left], group_of[is_left], row_of[is_left]
                failures = list({(one.vehicle.tobytes(), one.points): one for one in first if one}.values())
                self._failures = failures + self._failures
        return found

    def _survivors(self, shares: FloatArray, failures: Sequence[Failure]) -> npt.NDArray[np.intp]:
        """The rows of candidates that survive some vehicles at their points, few vehicles of one point at a time."""
        left = np.arange(len(shares))
        for points in dict.fromkeys(one.points for one in failures):
            vehicles = np.array([one.vehicle for one in failures if one.points == points])
            while len(vehicles) and len(left):
                number = max(1, BATCH // len(left))
                stage = "candidates with single vehicles"
                degrees, _ = self.problem.degrees(shares[left], vehicles[:number], stage, points)
                left, vehicles = left[(degrees >= self.problem.margin).all(axis=1)], vehicles[number:]
        return left

    def _box(self, subset: Subset, half: float, number: int) -> FloatArray:
        """Candidates in the box of a subset that goes `half` of the ranges from today, and on its diagonals; the
        smallest changes first.
        """
        today, columns = self.problem.today, list(subset)
        lower, upper = np.maximum(today - half, 0.0)[columns], np.minimum(today + half, 1.0)[columns]
        inner = lower + sobol_points(SOBOL_SETS // self._thinning, len(columns), number) * (upper - lower)
        steps = np.arange(self._thinning, DIAGONAL_SETS + 1, self._thinning) / DIAGONAL_SETS * half
        diagonals = [today[columns] + np.outer(steps, signs) for signs in product((-1.0, 1.0), repeat=len(columns))]
        points = np.concatenate([inner, np.clip(np.concatenate(diagonals), 0.0, 1.0)])
        shares = np.tile(today, (len(points), 1))
        shares[:, columns] = points
        return shares[np.argsort(self.change(shares), kind="stable")]

    def _shrink(self, subsets: Sequence[Subset]) -> None:
        """Move changes back towards today: all together, then each by itself."""
        self._move_back({subset: list(subset) for subset in subsets})
        for place in range(max(map(len, subsets), default=0)):
            self._move_back({subset: [subset[place]] for subset in subsets if 1 < len(subset) > place})

    def _move_back(self, columns: Mapping[Subset, list[int]]) -> None:
        """Move some columns of changes towards today: on a grid, then between two of its points."""
        today, ends = self.problem.today, [self.best[subset] for subset in columns]
        low, high = np.zeros(len(columns)), np.ones(len(columns))
        for _ in range(2):
            steps = low[:, np.newaxis] + np.outer(high - low, np.arange(1, LINE_SETS + 1) / LINE_SETS)
            lines = [np.tile(end, (LINE_SETS, 1)) for end in ends]
            for (subset, moved), line, step, end in zip(columns.items(), lines, steps, ends, strict=True):
                line[:, moved] = today[moved] + np.outer(step, end[moved] - today[moved])
                line[-1] = self.best[subset]
            for number, (subset, row) in enumerate(zip(columns, self._least(lines), strict=True)):
                if row is not None:
                    self.best[subset] = lines[number][row]
                    low[number], high[number] = steps[number][row - 1] if row else low[number], steps[number][row]

    def _by_cma_es(self) -> FloatArray | None:
        """A change of all parameters that survives all counterexamples, by CMA-ES: the worst case over them counts."""
        import cma  # slow to import

        options = {"bounds": [0, 1], "seed": self.problem.study.search.seed % 2**31 + 1, "verbose": -9}
        strategy = cma.CMAEvolutionStrategy(np.clip(self.problem.today, 0.1, 0.9), 0.3, options)
        best: FloatArray | None = None
        for _ in range(GENERATIONS):
            shares = np.clip(np.array(strategy.ask()), 0.0, 1.0)
            vehicles = self.vehicles[:FIRST_VEHICLES]
            degrees, _ = self.problem.degrees(shares, vehicles, "all parameters together", self.seen)
            lack, change = np.clip(self.problem.margin - degrees.min(axis=1), 0.0, 100.0), self.change(shares)
            for row in np.argsort(change, kind="stable"):
                if lack[row] == 0 and (best is None or change[row] < self.change(best)):
                    (failure,) = self.first_failures(shares[[row]])
                    if failure is None:
                        best = shares[row]
                        break
                    self.add(failure.vehicle[np.newaxis])
            strategy.tell(list(shares), np.where(lack > 0, 1 + lack, change).tolist())
        return best
