"""Finds the smallest changes of one and of two parameters that survive all known counterexamples
(keep them safe).

A change is a set of values of the parameters, as positions in their ranges from 0 to 1. Its size is
the largest difference of a parameter from today's value. Changes lie on rings around the parameters
of today. They are first tried with a few hard cases, in order of their size. The smallest change
that survives these is tried with all cases. If it fails with a case, all changes are tried with
this case; otherwise it is the smallest change.
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
"""RINGS is the number of sizes that are tried. The same number is tried again between the size that
survives and the size below it. SIDE is the number of changes on a side of a ring; it is even, so
that no change on a ring of two parameters leaves one of them at today's value.
"""
THINNING = 4
"""Factor by which rings and changes on a side are fewer if the ADS needs an object for each change.
"""
LEAST_GAIN = 0.006
"""Least difference by which a change of two parameters must be smaller than a change of one."""
CHUNK = 2048
BATCH = 2048
"""Number of changes that are tried at a time, the smallest first; and number of simulations in a
batch.
"""
FIRST_CASES = 512
"""Number of cases in the first batch with which a change is tried. Each further batch has four
times as many cases.
"""


class Search:
    """Searches the smallest changes that survive the L known cases, shape (L, n + 1 + k), of which
    the worst comes first.

    More counterexamples can only make the smallest change of a number of parameters larger. So
    `_least`, a size up to which no change survived, stays a lower bound for ever.
    """

    def __init__(self, problem: RepairProblem, cases: FloatArray) -> None:
        self.problem = problem
        self.cases = cases
        self._thinning = 1 if problem.drives_arrays else THINNING
        self._hardest = cases[:1]
        """The cases with which changes failed, the last one first."""
        self._best = dict[int, FloatArray]()
        self._least = dict[int, float]()

    def add(self, cases: FloatArray) -> None:
        """Add counterexamples. New cases are tried before all others; each case is kept once."""
        rows = np.concatenate([cases, self.cases])
        self.cases = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]

    def smallest_changes(self) -> list[FloatArray]:
        """The changes, shape (P,), that survive all counterexamples. If the parameters of today
        survive, they are the only change. Otherwise: the smallest change of one parameter, and the
        smallest change of two, if it is smaller.
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
        """The smallest surviving change of `number` parameters, up to the size `limit`; None if no
        tried change survives.
        """
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
        """The changes, shape (M, P), of each subset of `number` parameters with the given sizes.
        Changes of the same size are ordered by the sum of their differences from today.
        """
        today = self.problem.today
        size = len(today)
        ring = np.array(
            list(product(np.linspace(-1.0, 1.0, SIDE // self._thinning), repeat=number))
        )
        ring = ring[np.max(np.abs(ring), axis=1) == 1]
        subsets = list(combinations(range(size), number))
        moves: FloatArray = np.zeros((len(subsets), len(ring), size))
        for row, subset in enumerate(subsets):
            moves[row][:, subset] = ring
        moves = moves.reshape(-1, size)
        moves = moves[np.argsort(np.sum(np.abs(moves), axis=1), kind="stable")]
        changes = (today + sizes[:, np.newaxis, np.newaxis] * moves).reshape(-1, size)
        return changes[((changes >= 0) & (changes <= 1)).all(axis=1)]

    def _failure_of(self, change: FloatArray) -> FloatArray | None:
        """A case with which a change fails, shape (1, n + 1 + k); None if the change survives all
        cases. The case is the worst of the first batch with a failure.
        """
        start = 0
        size = FIRST_CASES
        while start < len(self.cases):
            cases = self.cases[start : start + size]
            (robustness,) = self.problem.robustness_of_changes(
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
        """The row of the first of M changes, shape (M, P), that survives all cases; None if no
        change survives.
        """
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
        """The rows of the changes that survive `cases`; a batch has about `BATCH` simulations."""
        alive = np.arange(len(changes))
        while cases.size and alive.size:
            count = max(1, BATCH // len(alive))
            robustness = self.problem.robustness_of_changes(
                changes[alive], cases[:count], "changes with one case"
            )
            alive = alive[(robustness >= 0).all(axis=1)]
            cases = cases[count:]
        return alive
