"""Ensemble Kalman inversion: moves an ensemble of random places to a region where all rows of the published data
fit.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit, logit
from threadpoolctl import threadpool_limits

from safevar_sumo.records import FloatArray
from safevar_sumo.reference.search import SearchRace

MARGIN = 1e-4
"""Distance that the places of an ensemble keep from the ends of the bounds, as a share of the bounds' width."""
PLACE_DECIMALS = 4
"""Decimals of the places: last digits that depend on how residuals were computed do not reach the search that
follows."""
SPREAD = 0.08
"""The axes are those of the step with the mean standard deviation of places next to this share of the bounds' width."""
LEAST_VARIANCE = 1e-5
"""Added to the variance of every parameter, so that the axes span the space."""
STEP_SHARE = 0.5
"""Share that a step uses of the weight that Iglesias and Yang (2021) allow: residuals are not linear in the
parameters."""


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
    return STEP_SHARE * max(
        count / (2 * mean) if mean else 1.0, float(np.sqrt(count / (2 * variance))) if variance else 1.0
    )


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
