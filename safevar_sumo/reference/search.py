"""Searches for the lowest loss of studies that are fitted together, by CMA-ES."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study

Together = tuple[Study, ...]
"""Studies that are fitted together."""


class Space(Protocol):
    """Studies that are fitted together, by their place in the unit cube of the bounds, and their losses."""

    def at(self, shares: FloatArray) -> Together: ...

    def losses(self, studies: Sequence[Together]) -> list[float]: ...


KEPT_LOSS = 1.25
"""Trials up to this multiple of the lowest loss are kept, for profiles and the spread."""
SCREENING = 4
"""Screening takes at most one in this number of trials."""


class TrialSearch:
    """Keeps the best studies of all trials, and counts the trials left.

    Parameters
    ----------
    population
        Trials in a generation of a search that has no population of its own.
    done
        Called after every trial with the lowest loss so far, and the studies that have it.
    alike
        Trials whose loss exceeds the lowest by at most this share of it fit as well as the best.
    """

    def __init__(self, space: Space, population: int, trials: int, done: Callable[[float, Together], None], alike: float = 0.0) -> None:
        self.alike = alike
        self.best: Together | None = None
        self.loss, self.left = np.inf, trials
        self.kept: list[tuple[float, FloatArray]] = []
        """Losses and places of the trials whose loss is at most `KEPT_LOSS` times the lowest loss until then."""
        self.space, self.population, self._done = space, population, done

    def try_studies(self, studies: Sequence[Together]) -> list[float]:
        """The losses of studies, a trial each."""
        losses = self.space.losses(studies)
        self.left -= len(losses)
        for together, loss in zip(studies, losses, strict=True):
            if self.best is None or loss < self.loss:
                self.best, self.loss = together, loss
            self._done(self.loss, self.best)
        return losses

    def begin(self, place: FloatArray, spread: float, seed: int, population: int | None = None) -> OneSearch:
        """A search from a place in the unit cube, `spread` wide at first (standard deviation), with a population of its own if given."""
        return OneSearch(self, place, spread, seed, population or self.population)

    def from_random_places(self, same: Sequence[int], starts: int, screened: int, spread: float,
                           rng: np.random.Generator) -> list[OneSearch]:
        """Searches from random places, or from the best of `screened` random places; `SCREENING` limits their number.

        Parameter i starts at the same share of its bounds as parameter `same[i]`.
        """
        screened = min(screened, self.left // SCREENING) if starts else 0
        if screened < max(starts, 1):
            return [self.begin(rng.random(len(same))[same], spread, int(rng.integers(1, 2**31))) for _ in range(starts)]
        places = rng.random((screened, len(same)))[:, same]
        losses = [loss for k in range(0, screened, self.population)
                 for loss in self.try_studies([self.space.at(place) for place in places[k:k + self.population]])]
        return [self.begin(places[k], spread, int(rng.integers(1, 2**31))) for k in np.argsort(losses, kind="stable")[:starts]]

    def race(self, searches: Sequence[OneSearch]) -> None:
        """Spend all trials left by successive halving (Jamieson and Talwalkar 2016).

        All rounds have the same number of trials, and each has half as many searches as the one before; the last search gets the remainder.
        """
        racing = list(searches)
        rounds = 1 + (len(racing) - 1).bit_length()
        share = self.left // rounds
        for _ in range(rounds):
            each = share // len(racing)
            for one in racing:
                one.advance(each - each % one.population if each > one.population else each)
            racing = sorted(racing, key=lambda one: one.lowest)[:(len(racing) + 1) // 2]
        racing[0].advance(self.left)


class OneSearch:
    """CMA-ES (Hansen 2016) from one place, with its population; `lowest` is its lowest loss so far."""

    def __init__(self, search: TrialSearch, place: FloatArray, spread: float, seed: int, population: int) -> None:
        import cma  # takes longer to load than all the rest

        self._search, self.lowest, self.population = search, np.inf, population
        self._strategy: Any = cma.CMAEvolutionStrategy(place, spread, {
            "bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": population, "maxstd": np.inf})

    def advance(self, trials: int) -> None:
        """Run generations; CMA-ES does not learn from a last generation that is cut short."""
        search = self._search
        for left in range(trials, 0, -self.population):
            shares = self._strategy.ask()
            losses = search.try_studies([search.space.at(share) for share in shares[:left]])
            search.kept += [(loss, share) for loss, share in zip(losses, shares, strict=False) if loss <= KEPT_LOSS * search.loss]
            self.lowest = min(self.lowest, min(losses))
            if len(losses) == len(shares):
                self._strategy.tell(shares, losses)
