"""Ensemble Kalman inversion on models whose answer is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.special import logit

from safevar_sumo.records import FloatArray
from safevar_sumo.reference.ensemble import invert
from safevar_sumo.reference.search import Misfit, SearchRace

TRUTH = np.array([0.7, 0.2, 0.45])


class LinearModel:
    """Residuals are linear in the places' logits, with noise of `noise`; computed elsewhere, their last digits may be
    others.
    """

    def __init__(self, noise: float, rows: int = 60, last_digits: float = 0.0) -> None:
        self.matrix, self.noise = np.random.default_rng(8).standard_normal((rows, len(TRUTH))), noise
        self.places, self.last_digits = list[FloatArray](), last_digits

    def residuals(self, place: FloatArray) -> FloatArray:
        return np.asarray(self.matrix @ (logit(place) - logit(TRUTH)) / self.noise * (1 + self.last_digits))

    def misfits_at(self, places: Sequence[FloatArray]) -> list[Misfit]:
        self.places.extend(places)
        return [Misfit(float((values**2).sum()), values) for values in map(self.residuals, places)]


def inversion_of(
    model: LinearModel, size: int, max_trials: int, seed: int = 1
) -> tuple[FloatArray, FloatArray, SearchRace]:
    race = SearchRace(model.misfits_at, 8, 10_000, lambda loss, best: None)
    return *invert(race, len(TRUTH), size, max_trials, np.random.default_rng(seed)), race


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_linear_model_is_inverted_and_the_last_places_scatter_as_the_posterior(seed: int) -> None:
    """With weak prior knowledge the posterior of a linear model is the least-squares estimate with covariance (A.T
    A)^-1 noise^2.
    """
    model = LinearModel(noise=0.5)
    place, _, race = inversion_of(model, 400, 10_000, seed)
    assert place == pytest.approx(TRUTH, abs=0.03)
    last = logit(np.array(model.places[-400:]))
    covariance = np.linalg.inv(model.matrix.T @ model.matrix) * model.noise**2
    assert last.mean(axis=0) == pytest.approx(logit(TRUTH), abs=0.05)
    assert np.cov(last.T) == pytest.approx(covariance, abs=0.3 * covariance.max())
    assert race.trials_left == 10_000 - len(model.places)
    assert race.lowest_loss == float((model.residuals(place) ** 2).sum())


def test_the_axes_are_those_of_the_places_on_the_way_with_a_mean_deviation_of_one() -> None:
    """Parameters that the data ties together stay tied together: here the first two count by their sum alone."""
    model = LinearModel(noise=0.05)
    model.matrix[:, 1] = model.matrix[:, 0]
    axes = inversion_of(model, 200, 10_000)[1]
    covariance = axes @ axes.T
    assert np.sqrt(np.diag(covariance)).mean() == pytest.approx(1.0)
    assert covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) < -0.8


@pytest.mark.parametrize(("size", "max_trials"), [(2, 2), (2, 7), (10, 39), (30, 95)])
def test_an_inversion_ends_before_it_exceeds_its_trials(size: int, max_trials: int) -> None:
    model = LinearModel(noise=1e-6)
    place, axes, race = inversion_of(model, size, max_trials)
    assert max_trials - size < 10_000 - race.trials_left == len(model.places) <= max_trials
    assert any((place == tried).all() for tried in model.places)
    assert np.isfinite(axes).all()


def test_places_stay_in_the_bounds_where_the_data_pulls_beyond_them() -> None:
    class Beyond(LinearModel):
        def residuals(self, place: FloatArray) -> FloatArray:
            return (place - 2) / 1e-3

    model = Beyond(noise=1.0)
    place = inversion_of(model, 50, 2_000)[0]
    assert ((np.array(model.places) > 0) & (np.array(model.places) < 1)).all()
    assert (place > 0.99).all()


def test_data_without_weight_move_nothing() -> None:
    model = LinearModel(noise=1.0, rows=0)
    inversion_of(model, 20, 2_000)
    assert np.array(model.places[-20:]) == pytest.approx(np.array(model.places[:20]))


def test_last_digits_of_residuals_do_not_reach_the_search_that_follows() -> None:
    """Two computations of one fit, such as on two computers, try the same places, although their residuals differ in
    the last digits.
    """
    tried = []
    for model in (LinearModel(noise=0.5), LinearModel(noise=0.5, last_digits=1e-12)):
        place, axes, race = inversion_of(model, 40, 1000)
        race.begin(place, 0.05, seed=3, axes=axes).advance(160)
        tried.append(np.array(model.places))
    assert len(tried[0]) > 200
    assert (tried[0] == tried[1]).all()
