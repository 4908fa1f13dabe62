"""Searches, by CMA-ES, for the lowest loss of studies that are fitted together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study

StudyGroup = tuple[Study, ...]
"""Studies that are fitted together."""


class Space(Protocol):
    """Maps places in the unit cube of the parameters' bounds to studies, and studies to their losses."""

    def studies_at(self, place: FloatArray) -> StudyGroup: ...

    def losses(self, groups: Sequence[StudyGroup]) -> list[float]: ...


MAX_KEPT_RATIO = 1.25
"""A trial is kept, for profiles and the spread, if its loss is at most this multiple of the lowest loss."""
SCREENING_DIVISOR = 4
"""Screening takes at most the trials divided by this number."""


class Trial(NamedTuple):
    """A tried place in the unit cube of the parameters' bounds, and the loss of its studies."""

    loss: float
    place: FloatArray


class SearchRace:
    """Searches that compete for a number of trials; keeps the studies of the best trial, and counts the trials left.

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
        self.lowest_loss, self.trials_left = np.inf, trials
        self.kept: list[Trial] = []
        """Trials of searches with a loss of at most `MAX_KEPT_RATIO` times the lowest loss at the time of the trial."""
        self.space, self.population, self._done = space, population, done

    def try_studies(self, groups: Sequence[StudyGroup]) -> list[float]:
        """The losses of groups of studies; each group is one trial."""
        losses = self.space.losses(groups)
        self.trials_left -= len(losses)
        for group, loss in zip(groups, losses, strict=True):
            if self.best is None or loss < self.lowest_loss:
                self.best, self.lowest_loss = group, loss
            self._done(self.lowest_loss, self.best)
        return losses

    def begin(self, place: FloatArray, deviation: float, seed: int, population: int | None = None) -> CmaSearch:
        """Begin a search at a place, with `deviation` as initial standard deviation; the race's population is the default."""
        return CmaSearch(self, place, deviation, seed, population or self.population)

    def begin_at_random_places(self, first_indices: Sequence[int], starts: int, screened: int, deviation: float,
                               rng: np.random.Generator) -> list[CmaSearch]:
        """Begin `starts` searches at random places, or at the best of `screened` random places.

        Screening takes at most 1 / `SCREENING_DIVISOR` of the trials left. Parameter i starts at the same share of its bounds as parameter
        `first_indices[i]`.
        """
        size = len(first_indices)
        screened = min(screened, self.trials_left // SCREENING_DIVISOR) if starts else 0
        if screened < max(starts, 1):
            return [self.begin(rng.random(size)[first_indices], deviation, int(rng.integers(1, 2**31))) for _ in range(starts)]
        places = rng.random((screened, size))[:, first_indices]
        losses = [loss for k in range(0, screened, self.population)
                 for loss in self.try_studies([self.space.studies_at(place) for place in places[k:k + self.population]])]
        return [self.begin(places[k], deviation, int(rng.integers(1, 2**31))) for k in np.argsort(losses, kind="stable")[:starts]]

    def run(self, searches: Sequence[CmaSearch]) -> None:
        """Spend all trials left by successive halving (Jamieson and Talwalkar 2016).

        All rounds have the same number of trials. Half of the searches reach the next round; the last search gets the remaining trials.
        """
        competitors = list(searches)
        rounds = 1 + (len(competitors) - 1).bit_length()
        trials_per_round = self.trials_left // rounds
        for _ in range(rounds):
            trials = trials_per_round // len(competitors)
            for search in competitors:
                search.advance(trials - trials % search.population if trials > search.population else trials)
            competitors = sorted(competitors, key=lambda search: search.lowest_loss)[:(len(competitors) + 1) // 2]
        competitors[0].advance(self.trials_left)


class CmaSearch:
    """One search by CMA-ES (Hansen 2016); `lowest_loss` is that of its trials so far."""

    def __init__(self, race: SearchRace, place: FloatArray, deviation: float, seed: int, population: int) -> None:
        import cma  # slow to import

        self._race, self.lowest_loss, self.population = race, np.inf, population
        self._strategy: Any = cma.CMAEvolutionStrategy(place, deviation, {
            "bounds": [0, 1], "seed": seed, "verbose": -9, "popsize": population, "maxstd": np.inf})

    def advance(self, trials: int) -> None:
        """Run generations for a number of trials; CMA-ES does not learn from an incomplete last generation."""
        race = self._race
        for trials_left in range(trials, 0, -self.population):
            places = self._strategy.ask()
            losses = race.try_studies([race.space.studies_at(place) for place in places[:trials_left]])
            max_loss = MAX_KEPT_RATIO * race.lowest_loss
            race.kept += [Trial(loss, place) for loss, place in zip(losses, places, strict=False) if loss <= max_loss]
            self.lowest_loss = min(self.lowest_loss, min(losses))
            if len(losses) == len(places):
                self._strategy.tell(places, losses)
