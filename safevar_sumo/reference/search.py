"""Searches, by CMA-ES, for the lowest loss of studies that are fitted together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study

StudyGroup = tuple[Study, ...]
"""Studies that are fitted together."""


class Misfit(NamedTuple):
    """The loss of studies, and their residuals in standard deviations of the residuals' noise."""

    loss: float
    residuals: FloatArray


class Space(Protocol):
    """Maps places in the unit cube of the parameters' bounds to studies, and studies to their misfits."""

    def studies_at(self, place: FloatArray) -> StudyGroup: ...

    def misfits(self, groups: Sequence[StudyGroup]) -> list[Misfit]: ...


MAX_KEPT_RATIO = 1.25
"""A trial is kept, for profiles and the spread, if its loss is at most this multiple of the lowest loss."""


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
        self._space, self.population, self._done = space, population, done

    def try_studies(self, groups: Sequence[StudyGroup]) -> list[Misfit]:
        """The misfits of groups of studies; each group is one trial."""
        misfits = self._space.misfits(groups)
        self.trials_left -= len(misfits)
        for group, misfit in zip(groups, misfits, strict=True):
            if self.best is None or misfit.loss < self.lowest_loss:
                self.best, self.lowest_loss = group, misfit.loss
            self._done(self.lowest_loss, self.best)
        return misfits

    def try_places(self, places: Sequence[FloatArray] | FloatArray) -> list[Misfit]:
        """The misfits of the studies at places; each place is one trial."""
        return self.try_studies([self._space.studies_at(place) for place in places])

    def begin(self, place: FloatArray, deviation: float, seed: int, population: int | None = None,
              axes: FloatArray | None = None) -> CmaSearch:
        """Begin a search at a place, with `deviation` as initial standard deviation along `axes`; the race's population is the default."""
        return CmaSearch(self, place, deviation, seed, population or self.population, np.eye(len(place)) if axes is None else axes)

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
    """One search by CMA-ES (Hansen 2016); `lowest_loss` is that of its trials so far.

    Its first generation has the covariance `deviation`**2 * `axes` @ `axes`.T, where `axes` has the shape (n, n).
    """

    def __init__(self, race: SearchRace, place: FloatArray, deviation: float, seed: int, population: int, axes: FloatArray) -> None:
        import cma  # slow to import

        self._race, self.lowest_loss, self.population = race, np.inf, population
        self._axes, self._bounds = axes, cma.BoundTransform([0, 1])
        self._strategy: Any = cma.CMAEvolutionStrategy(np.linalg.solve(axes, self._bounds.inverse(place)), deviation, {
            "seed": seed, "verbose": -9, "popsize": population, "maxstd": np.inf})

    def advance(self, trials: int) -> None:
        """Run generations for a number of trials; CMA-ES does not learn from an incomplete last generation."""
        race = self._race
        for trials_left in range(trials, 0, -self.population):
            coordinates = self._strategy.ask()
            places = [np.asarray(self._bounds.repair(self._axes @ point)) for point in coordinates]
            losses = [misfit.loss for misfit in race.try_places(places[:trials_left])]
            max_loss = MAX_KEPT_RATIO * race.lowest_loss
            race.kept += [Trial(loss, place) for loss, place in zip(losses, places, strict=False) if loss <= max_loss]
            self.lowest_loss = min(self.lowest_loss, min(losses))
            if len(losses) == len(places):
                self._strategy.tell(coordinates, losses)
