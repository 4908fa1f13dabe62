"""The smallest changes of one and of two parameters that survive all known counterexamples.

A change is a set of parameters; its size is the largest change of one of them. Changes on rings
around the parameters of today, the smallest first, are tried with single cases. Only the smallest
of those that survive is tried with all cases. Either it fails with a case, with which all changes
are then tried, or it is the smallest change.
"""

from __future__ import annotations

from itertools import combinations, product

import numpy as np

from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.records import FloatArray, IntArray

MOST_CHANGED = 2
"""Largest number of parameters that change together."""
RINGS = 32
SIDE = 12
"""Number of sizes that are tried, and again between the size that survives and the one below; of
places on a side of a ring. It is even, so that both parameters change everywhere.
"""
THINNING = 4
"""Factor by which an ADS that needs an instance for each set of parameters has fewer rings and
places on a side.
"""
LEAST_GAIN = 0.006
"""By how much a change of two parameters has to be smaller than that of one."""
CHUNK = 2048
BATCH = 2048
"""Number of changes that are tried at a time, the smallest first; of simulations in a batch."""
FIRST_CASES = 512
"""Number of the first cases with which a change is tried first; then with four times as many, and
so on.
"""


class Search:
    """Searches the smallest changes that survive cases, shape (L, n + 1 + k), worst first.

    Counterexamples only make the smallest change of a number of parameters larger. So `_least`, a
    size at which there was none, is a lower bound for ever.
    """

    def __init__(self, problem: RepairProblem, cases: FloatArray) -> None:
        self.problem = problem
        self.cases = cases
        self._thinning = 1 if problem.arrays else THINNING
        self._hardest = cases[:1]
        """The cases with which changes failed, the last one first."""
        self._best = dict[int, FloatArray]()
        self._least = dict[int, float]()

    def add(self, cases: FloatArray) -> None:
        """Add counterexamples, which are tried first."""
        rows = np.concatenate([cases, self.cases])
        self.cases = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]

    def smallest_changes(self) -> list[FloatArray]:
        """The parameters of today if they survive all counterexamples; otherwise the smallest
        change of one parameter and that of two, if it is smaller.
        """
        today = self.problem.today
        if self._failure_of(today) is None:
            return [today]
        changes = []
        limit = 1.0
        for number in range(1, min(MOST_CHANGED, len(today)) + 1):
            change = self._smallest_change(number, limit)
            if change is not None:
                changes.append(change)
                limit = float(np.max(np.abs(change - today))) - LEAST_GAIN
        return changes

    def _smallest_change(self, number: int, limit: float) -> FloatArray | None:
        """The smallest change of a number of parameters, up to a limit."""
        best = self._best.pop(number, None)
        if best is None or self._failure_of(best) is not None:
            best = None
            low = self._least.get(number, 0.0)
            high = limit
            for _ in range(2 if low < high else 0):
                count = RINGS // self._thinning
                sizes = low + (high - low) * np.arange(1, count + 1) / count
                changes = self._rings(number, sizes)
                row = self._first_survivor(changes)
                if row is None:
                    break
                best = changes[row]
                size = np.max(np.abs(best - self.problem.today))
                ring = int(np.argmax(sizes >= size - 1e-12))
                low = float(sizes[ring - 1]) if ring else low
                high = float(sizes[ring])
            self._least[number] = low if best is not None else max(low, high)
        if best is not None:
            self._best[number] = best
        return best

    def _rings(self, number: int, sizes: FloatArray) -> FloatArray:
        """Changes of each subset of a number of parameters with these sizes; of equal ones first
        that with the smallest sum.
        """
        today = self.problem.today
        ring = np.array(
            list(product(np.linspace(-1.0, 1.0, SIDE // self._thinning), repeat=number))
        )
        ring = ring[np.max(np.abs(ring), axis=1) == 1]
        subsets = list(combinations(range(len(today)), number))
        moves: FloatArray = np.zeros((len(subsets), len(ring), len(today)))
        for row, subset in enumerate(subsets):
            moves[row][:, subset] = ring
        moves = moves.reshape(-1, len(today))
        moves = moves[np.argsort(np.sum(np.abs(moves), axis=1), kind="stable")]
        changes = (today + sizes[:, np.newaxis, np.newaxis] * moves).reshape(
            -1, len(today)
        )
        return changes[((changes >= 0) & (changes <= 1)).all(axis=1)]

    def _failure_of(self, change: FloatArray) -> FloatArray | None:
        """The worst of the first cases with which a change fails, shape (1, n + 1 + k); None if it
        survives all.
        """
        start = 0
        size = FIRST_CASES
        while start < len(self.cases):
            cases = self.cases[start : start + size]
            (robustness,) = self.problem.robustness_of_each(
                change[np.newaxis],
                cases,
                "changes with all cases",
            )
            worst = int(np.argmin(robustness))
            if robustness[worst] < 0:
                return cases[worst : worst + 1]
            start += size
            size *= 4
        return None

    def _first_survivor(self, changes: FloatArray) -> int | None:
        """The row of the first change, shape (M, P), that survives all cases; None if none does."""
        for start in range(0, len(changes), CHUNK):
            rows = np.arange(start, min(start + CHUNK, len(changes)))
            rows = rows[self._survivors(changes[rows], self._hardest)]
            while len(rows):
                failure = self._failure_of(changes[rows[0]])
                if failure is None:
                    return int(rows[0])
                self._hardest = np.vstack([failure, self._hardest])
                rows = rows[self._survivors(changes[rows], failure)]
        return None

    def _survivors(self, changes: FloatArray, cases: FloatArray) -> IntArray:
        """The rows of the changes that survive cases; few at a time."""
        alive = np.arange(len(changes))
        while cases.size and alive.size:
            count = max(1, BATCH // len(alive))
            robustness = self.problem.robustness_of_each(
                changes[alive], cases[:count], "changes with one case"
            )
            alive = alive[(robustness >= 0).all(axis=1)]
            cases = cases[count:]
        return alive
