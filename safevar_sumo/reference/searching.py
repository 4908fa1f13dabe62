"""CMA-ES from many places at once, of which the worse half gives up after every round."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study


class Trial(Protocol):
    """What is tried: studies by their place in the unit cube of the bounds, and what they cost."""

    def at(self, shares: FloatArray) -> Study: ...

    def costs(self, studies: Sequence[Study]) -> list[float]: ...


class Search:
    """Keeps the best study of all that are tried, and count of the trials that are left.

    Parameters
    ----------
    population
        Trials in a generation.
    done
        Is called after every trial with the lowest cost so far, and the study that has it.
    """

    def __init__(self, trial: Trial, population: int, trials: int, done: Callable[[float, Study], None]) -> None:
        self.best: Study | None = None
        self.cost, self.left = np.inf, trials
        self.trial, self.population, self._done = trial, population, done

    def tried(self, studies: Sequence[Study]) -> list[float]:
        """What studies cost."""
        costs = self.trial.costs(studies)
        self.left -= len(costs)
        for study, cost in zip(studies, costs, strict=True):
            if self.best is None or cost < self.cost:
                self.best, self.cost = study, cost
            self._done(self.cost, self.best)
        return costs

    def begun(self, place: FloatArray, spread: float, seed: int) -> OneSearch:
        """A search from a place in the unit cube, `spread` wide at first (standard deviation)."""
        return OneSearch(self, place, spread, seed)

    def race(self, searches: Sequence[OneSearch]) -> None:
        """Successive halving (Jamieson and Talwalkar 2016) of all trials that are left.

        Rounds have as many trials each, shared by half as many searches each time; the last has two, and the winner what is left over.
        """
        racing = list(searches)
        rounds = max(1, (len(racing) - 1).bit_length())
        share = self.left // rounds
        for _ in range(rounds):
            each = share // len(racing)
            for one in racing:
                one.go_on(each - each % self.population if each > self.population else each)
            racing = sorted(racing, key=lambda one: one.lowest)[:(len(racing) + 1) // 2]
        racing[0].go_on(self.left)


class OneSearch:
    """CMA-ES (Hansen 2016) from one place; `lowest` is the least that it has found to cost."""

    def __init__(self, search: Search, place: FloatArray, spread: float, seed: int) -> None:
        import cma  # only here: it takes longer to load than all the rest

        self._search, self.lowest = search, np.inf
        self._strategy: Any = cma.CMAEvolutionStrategy(place, spread, {
            "bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": search.population, "maxstd": np.inf})

    def go_on(self, trials: int) -> None:
        """Generation after generation; nothing is learnt from a last one that is cut short."""
        search = self._search
        for left in range(trials, 0, -search.population):
            shares = self._strategy.ask()
            costs = search.tried([search.trial.at(share) for share in shares[:left]])
            self.lowest = min(self.lowest, min(costs))
            if len(costs) == len(shares):
                self._strategy.tell(shares, costs)
