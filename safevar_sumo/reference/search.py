"""Searches, by CMA-ES, for the place with the lowest loss in the unit cube of the parameters' bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray

MAX_KEPT_RATIO = 1.25
"""A trial is kept, for profiles and the spread, if its loss is at most this multiple of the lowest loss."""


class Misfit(NamedTuple):
    """The loss at a place, and the residuals in standard deviations of their noise."""

    loss: float
    residuals: FloatArray


class SearchRace:
    """Searches that compete for a number of trials; `best_place` has the lowest loss of all trials.

    Parameters
    ----------
    misfits_at
        Returns the misfits at places.
    population
        Default number of trials in a generation of a search.
    trials
        Number of trials in all; `trials_left` counts down from it.
    done
        Called after every trial with the lowest loss so far, and the place with this loss.
    """

    def __init__(
        self,
        misfits_at: Callable[[Sequence[FloatArray]], list[Misfit]],
        population: int,
        trials: int,
        done: Callable[[float, FloatArray], None],
    ) -> None:
        self._misfits_at, self.population, self.trials_left, self._done = misfits_at, population, trials, done
        self.best_place, self.lowest_loss = np.empty(0), np.inf
        self.kept: list[tuple[float, FloatArray]] = []
        """Loss and place of the searches' trials whose loss was at most `MAX_KEPT_RATIO` times the lowest loss then."""

    def try_places(self, places: Sequence[FloatArray]) -> list[Misfit]:
        """The misfits at places; each place is one trial."""
        misfits = self._misfits_at(places)
        self.trials_left -= len(misfits)
        for place, misfit in zip(places, misfits, strict=True):
            if not self.best_place.size or misfit.loss < self.lowest_loss:
                self.best_place, self.lowest_loss = np.asarray(place), misfit.loss
            self._done(self.lowest_loss, self.best_place)
        return misfits

    def begin(
        self,
        place: FloatArray,
        deviation: float,
        seed: int,
        population: int | None = None,
        axes: FloatArray | None = None,
    ) -> CmaSearch:
        """Begin a search at a place, with `deviation` as initial standard deviation along `axes`, by default the
        cube's.
        """
        return CmaSearch(
            self, place, deviation, seed, population or self.population, np.eye(len(place)) if axes is None else axes
        )

    def run(self, searches: Sequence[CmaSearch]) -> None:
        """Spend all trials left by successive halving (Jamieson and Talwalkar 2016).

        All rounds have the same number of trials. Half of the searches reach the next round; the last search gets the
        remaining trials.
        """
        competitors = list(searches)
        rounds = 1 + (len(competitors) - 1).bit_length()
        trials_per_round = self.trials_left // rounds
        for _ in range(rounds):
            trials = trials_per_round // len(competitors)
            for search in competitors:
                search.advance(trials - trials % search.population if trials > search.population else trials)
            competitors = sorted(competitors, key=lambda search: search.lowest_loss)[: (len(competitors) + 1) // 2]
        competitors[0].advance(self.trials_left)


class CmaSearch:
    """One search by CMA-ES (Hansen 2016); `lowest_loss` is that of its trials so far.

    Its first generation has the covariance `deviation`**2 * `axes` @ `axes`.T, where `axes` has the shape (n, n).
    """

    def __init__(
        self, race: SearchRace, place: FloatArray, deviation: float, seed: int, population: int, axes: FloatArray
    ) -> None:
        import cma  # slow to import

        self._race, self.lowest_loss, self.population = race, np.inf, population
        self._axes, self._bounds = axes, cma.BoundTransform([0, 1])
        self._strategy: Any = cma.CMAEvolutionStrategy(
            np.linalg.solve(axes, self._bounds.inverse(place)),
            deviation,
            {"seed": seed, "verbose": -9, "popsize": population, "maxstd": np.inf},
        )

    def advance(self, trials: int) -> None:
        """Run generations for a number of trials; CMA-ES does not learn from an incomplete last generation."""
        race = self._race
        for trials_left in range(trials, 0, -self.population):
            coordinates = self._strategy.ask()
            places = [np.asarray(self._bounds.repair(self._axes @ point)) for point in coordinates]
            losses = [misfit.loss for misfit in race.try_places(places[:trials_left])]
            max_loss = MAX_KEPT_RATIO * race.lowest_loss
            race.kept += [(loss, place) for loss, place in zip(losses, places, strict=False) if loss <= max_loss]
            self.lowest_loss = min(self.lowest_loss, *losses)
            if len(losses) == len(places):
                self._strategy.tell(coordinates, losses)
