"""Searches for the place with the lowest loss in the unit cube of the parameters' bounds: CMA-ES with restarts.

An ensemble Kalman inversion finds the region where all rows of the published data fit, in which a search begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, logit
from threadpoolctl import threadpool_limits

from safevar_sumo.records import FloatArray

MAX_KEPT_RATIO = 1.25
"""A trial is kept, for profiles and the spread, if its loss is at most this multiple of the lowest loss."""
MARGIN = 1e-4
"""Distance that an ensemble's places keep from the bounds, as a share of the bounds' width."""
PLACE_DECIMALS = 4
"""Decimals of an ensemble's places, so that last digits, which depend on how residuals were computed, do not reach the
search that follows."""
SPREAD = 0.08
"""A search takes its axes from the step of an inversion at which the places' mean standard deviation is nearest to this
share of the bounds' width."""
LEAST_VARIANCE = 1e-5
"""Added to the variance of every parameter, so that the axes span the space."""
STEP_SHARE = 0.5
"""Share of the weight that Iglesias and Yang (2021) allow a step: residuals are not linear in the parameters."""


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

    def run(self, searches: Sequence[CmaSearch]) -> None:
        """Spend all trials left by successive halving (Jamieson and Talwalkar 2016).

        All rounds have the same number of trials. Half of the searches reach the next round; the last search gets the
        remaining trials.
        """
        competitors = list(searches)
        rounds = 1 + (len(competitors) - 1).bit_length()  # as often as half of them, rounded up, can go on
        trials_per_round = self.trials_left // rounds
        for _ in range(rounds):
            trials = trials_per_round // len(competitors)
            for search in competitors:
                incomplete = trials % search.population if trials > search.population else 0
                search.advance(trials - incomplete)
            competitors = sorted(competitors, key=lambda search: search.lowest_loss)[: (len(competitors) + 1) // 2]
        competitors[0].advance(self.trials_left)


class CmaSearch:
    """One search by CMA-ES (Hansen 2016); `lowest_loss` is that of its trials so far.

    The first generation has the covariance `deviation`**2 * `axes` @ `axes`.T, where `axes` has the shape (n, n); by
    default they are the cube's. `population` is by default the race's.
    """

    def __init__(
        self,
        race: SearchRace,
        place: FloatArray,
        deviation: float,
        seed: int,
        population: int | None = None,
        axes: FloatArray | None = None,
    ) -> None:
        import cma  # slow to import

        self._race, self.lowest_loss, self.population = race, np.inf, population or race.population
        self._axes, self._bounds = np.eye(len(place)) if axes is None else axes, cma.BoundTransform([0, 1])
        self._strategy: Any = cma.CMAEvolutionStrategy(
            np.linalg.solve(self._axes, self._bounds.inverse(place)),
            deviation,
            {"seed": seed, "verbose": -9, "popsize": self.population, "maxstd": np.inf},
        )

    def advance(self, trials: int) -> None:
        """Run generations for a number of trials; CMA-ES does not learn from an incomplete last generation."""
        race = self._race
        for trials_left in range(trials, 0, -self.population):
            coordinates = self._strategy.ask()
            places = [np.asarray(self._bounds.repair(self._axes @ point)) for point in coordinates[:trials_left]]
            losses = [misfit.loss for misfit in race.try_places(places)]
            max_loss = MAX_KEPT_RATIO * race.lowest_loss
            race.kept += [(loss, place) for loss, place in zip(losses, places, strict=True) if loss <= max_loss]
            self.lowest_loss = min(self.lowest_loss, *losses)
            if len(losses) == len(coordinates):
                self._strategy.tell(coordinates, losses)


def invert(
    race: SearchRace, dimension: int, size: int, max_trials: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Move an ensemble of `size` (2 to `max_trials`) random places until the residuals are as small as their noise.

    Returns the place with the lowest loss, shape (n,), and the axes of the places on the way to it, shape (n, n):
    `axes` @ `axes`.T is their covariance, scaled so that the mean standard deviation is 1.

    Every step replaces the places by a sample from the posterior of a linear model of the residuals, with perturbed
    observations (Iglesias, Law and Stuart 2013). A step uses a part of the data's weight (Iglesias and Yang 2021); the
    inversion ends when it has used the whole weight, or before it exceeds `max_trials`. It moves the logits of the
    places, so that no place leaves the bounds.
    """
    places = rng.uniform(MARGIN, 1 - MARGIN, (size, dimension)).round(PLACE_DECIMALS)
    weight_used, trials_left, lowest_loss, best_place = 0.0, max_trials, np.inf, places[0]
    covariance, distance_from_spread = np.eye(dimension), np.inf
    while True:
        misfits = race.try_places(list(places))
        trials_left -= size
        losses = [misfit.loss for misfit in misfits]
        if min(losses) < lowest_loss:
            lowest_loss, best_place = min(losses), places[int(np.argmin(losses))]
        distance = abs(float(places.std(axis=0).mean()) - SPREAD)
        if distance < distance_from_spread:
            covariance, distance_from_spread = np.cov(places.T).reshape(dimension, dimension), distance
        if weight_used >= 1 or trials_left < size:
            axes = np.linalg.cholesky(covariance + LEAST_VARIANCE * np.eye(dimension))
            return best_place, np.asarray(axes / np.sqrt((axes**2).sum(axis=1)).mean())
        residuals = np.array([misfit.residuals for misfit in misfits])
        weight = min(_step_weight(residuals), 1 - weight_used)
        weight_used += weight
        places = _posterior_sample(places, residuals, weight, rng)


def _step_weight(residuals: FloatArray) -> float:
    """Share of the data's weight for a step, from residuals in standard deviations of their noise, shape (places,
    residuals).
    """
    misfits, count = (residuals**2).sum(axis=1) / 2, residuals.shape[1]
    mean, variance = float(misfits.mean()), float(misfits.var())
    by_mean = count / (2 * mean) if mean else 1.0
    by_variance = float(np.sqrt(count / (2 * variance))) if variance else 1.0
    return STEP_SHARE * max(by_mean, by_variance)


def _posterior_sample(places: FloatArray, residuals: FloatArray, weight: float, rng: np.random.Generator) -> FloatArray:
    """The places after a step with a share of the data's weight; the Kalman gain is computed in the space of the
    ensemble.
    """
    size = len(places)
    logits = logit(places)
    deviations = (residuals - residuals.mean(axis=0)) / np.sqrt(size - 1)
    perturbed = residuals + rng.standard_normal(residuals.shape) / np.sqrt(weight)
    with threadpool_limits(limits=1):  # with several threads the last digits depend on their number
        gain = np.linalg.solve(
            deviations @ deviations.T + np.eye(size) / weight, (logits - logits.mean(axis=0)) / np.sqrt(size - 1)
        )
        moved_logits = logits - (perturbed @ deviations.T) @ gain
    return np.asarray(np.clip(expit(moved_logits), MARGIN, 1 - MARGIN).round(PLACE_DECIMALS))
