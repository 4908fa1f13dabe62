"""Searches, by CMA-ES, for the lowest loss of studies that are fitted together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study

StudyGroup = tuple[Study, ...]
"""Studies that are fitted together."""


class Space(Protocol):
    """Maps places in the unit cube of the parameters' bounds to studies, and studies to their losses."""

    def at(self, shares: FloatArray) -> StudyGroup: ...

    def losses(self, studies: Sequence[StudyGroup]) -> list[float]: ...


KEPT_LOSS = 1.25
"""A trial is kept, for profiles and the spread, if its loss is at most this multiple of the lowest loss."""
SCREENING = 4
"""Screening takes at most the trials divided by this number."""


class TrialSearch:
    """Keeps the studies of the best trial, and counts the trials left.

    Parameters
    ----------
    population
        Default number of trials in a generation of a search.
    done
        Called after every trial with the lowest loss so far, and the studies with this loss.
    alike
        A trial fits as well as the best if its loss exceeds the lowest loss by at most this share of the lowest loss.
    """

    def __init__(self, space: Space, population: int, trials: int, done: Callable[[float, StudyGroup], None], alike: float = 0.0) -> None:
        self.alike = alike
        self.best: StudyGroup | None = None
        self.loss, self.trials_left = np.inf, trials
        self.kept: list[tuple[float, FloatArray]] = []
        """Losses and places of trials with a loss of at most `KEPT_LOSS` times the lowest loss at the time of the trial."""
        self.space, self.population, self._done = space, population, done

    def try_studies(self, studies: Sequence[StudyGroup]) -> list[float]:
        """The losses of groups of studies; each group is one trial."""
        losses = self.space.losses(studies)
        self.trials_left -= len(losses)
        for group, loss in zip(studies, losses, strict=True):
            if self.best is None or loss < self.loss:
                self.best, self.loss = group, loss
            self._done(self.loss, self.best)
        return losses

    def begin(self, place: FloatArray, spread: float, seed: int, population: int | None = None) -> OneSearch:
        """A search from a place in the unit cube, with `spread` as initial standard deviation; by default with the common population."""
        return OneSearch(self, place, spread, seed, population or self.population)

    def from_random_places(self, leaders: Sequence[int], starts: int, screened: int, spread: float,
                           rng: np.random.Generator) -> list[OneSearch]:
        """`starts` searches from random places, or from the best of `screened` random places, whose number `SCREENING` limits.

        Parameter i starts at the same share of its bounds as parameter `same[i]`.
        """
        screened = min(screened, self.trials_left // SCREENING) if starts else 0
        if screened < max(starts, 1):
            return [self.begin(rng.random(len(leaders))[leaders], spread, int(rng.integers(1, 2**31))) for _ in range(starts)]
        places = rng.random((screened, len(leaders)))[:, leaders]
        losses = [loss for k in range(0, screened, self.population)
                 for loss in self.try_studies([self.space.at(place) for place in places[k:k + self.population]])]
        return [self.begin(places[k], spread, int(rng.integers(1, 2**31))) for k in np.argsort(losses, kind="stable")[:starts]]

    def race(self, searches: Sequence[OneSearch]) -> None:
        """Spend all trials left by successive halving (Jamieson and Talwalkar 2016).

        All rounds have the same number of trials. Half of the searches reach the next round; the last search gets the remaining trials.
        """
        competitors = list(searches)
        rounds = 1 + (len(competitors) - 1).bit_length()
        share = self.trials_left // rounds
        for _ in range(rounds):
            trials = share // len(competitors)
            for search in competitors:
                search.advance(trials - trials % search.population if trials > search.population else trials)
            competitors = sorted(competitors, key=lambda search: search.lowest)[:(len(competitors) + 1) // 2]
        competitors[0].advance(self.trials_left)


class OneSearch:
    """One search by CMA-ES (Hansen 2016); `lowest` is its lowest loss so far."""

    def __init__(self, search: TrialSearch, place: FloatArray, spread: float, seed: int, population: int) -> None:
        import cma  # slow to import

        self._search, self.lowest, self.population = search, np.inf, population
        self._strategy: Any = cma.CMAEvolutionStrategy(place, spread, {
            "bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": population, "maxstd": np.inf})

    def advance(self, trials: int) -> None:
        """Run generations for a number of trials; CMA-ES does not learn from an incomplete last generation."""
        search = self._search
        for trials_left in range(trials, 0, -self.population):
            shares = self._strategy.ask()
            losses = search.try_studies([search.space.at(share) for share in shares[:trials_left]])
            search.kept += [(loss, share) for loss, share in zip(losses, shares, strict=False) if loss <= KEPT_LOSS * search.loss]
            self.lowest = min(self.lowest, min(losses))
            if len(losses) == len(shares):
                self._strategy.tell(shares, losses)
