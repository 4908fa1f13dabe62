"""Samples vehicles whose characteristics vary as a study's [variation] and [[correlations]] specify."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.study.variation import Correlation, Distribution, Fixed, Lognormal, Normal, Triangular, Uniform
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

QuantileFunction = Callable[[FloatArray], FloatArray]
"""Turns probabilities into values in the characteristic's unit."""


class VariationModel:
    """The random variation of a study's characteristics.

    Parameters
    ----------
    study
        The study, with its `[variation]` and `[[correlations]]`.

    Raises
    ------
    InputError
        If the correlations contradict each other.
    """

    def __init__(self, study: Study) -> None:
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._source = study.source
        self._quantiles = [self._quantile_function(characteristic, study.variation.get(characteristic.name, Uniform()))
                           for characteristic in self._characteristics]
        self._factor = self._correlating_factor(study.correlations)

    @property
    def is_correlated(self) -> bool:
        return self._factor is not None

    def settings(self, probabilities: FloatArray) -> FloatArray:
        """Settings at N independent points of the unit cube, shape (N, n); the settings are correlated as the study specifies."""
        if self._factor is not None:
            return self.settings_of_normal(scipy.stats.norm.ppf(probabilities))
        return self._settings_at(probabilities)

    def settings_of_normal(self, points: FloatArray) -> FloatArray:
        """Settings at N points of standard normal space, shape (N, n), correlated as the study specifies."""
        return self._settings_at(scipy.stats.norm.cdf(points if self._factor is None else points @ self._factor.T))

    def _settings_at(self, probabilities: FloatArray) -> FloatArray:
        columns = [quantile(column) for quantile, column in zip(self._quantiles, probabilities.T, strict=True)]
        return np.clip(np.stack(columns, axis=1), self._characteristics.lower, self._characteristics.upper)

    def _quantile_function(self, characteristic: Characteristic, distribution: Distribution) -> QuantileFunction:
        low, high = characteristic.lower, characteristic.upper
        match distribution:
            case Fixed():
                value = _or_default(distribution.value, characteristic.original)
                return lambda p: np.full_like(p, value)
            case Uniform() | Triangular():
                lower, upper = _or_default(distribution.lower, low), _or_default(distribution.upper, high)
                if isinstance(distribution, Uniform):
                    return lambda p: lower + p * (upper - lower)
                mode = _or_default(distribution.mode, characteristic.original)
                triangle = scipy.stats.triang((mode - lower) / (upper - lower), loc=lower, scale=upper - lower)
                return lambda p: np.asarray(triangle.ppf(p))
            case Normal():
                mean = _or_default(distribution.mean, characteristic.original)
                normal = _truncated_normal(low, high, mean, distribution.deviation)
                return lambda p: np.asarray(normal.ppf(p))
            case Lognormal():
                log_median = np.log(_or_default(distribution.median, characteristic.original))
                logarithm = _truncated_normal(np.log(low), np.log(high), log_median, distribution.sigma)
                return lambda p: np.exp(logarithm.ppf(p))

    def _correlating_factor(self, correlations: Sequence[Correlation]) -> FloatArray | None:
        """The Cholesky factor that correlates independent normal variables; None without correlations."""
        if not correlations:
            return None
        names = self._characteristics.names
        matrix = np.eye(len(names))
        for correlation in correlations:
            first, second = (names.index(name) for name in correlation.between)
            matrix[first, second] = matrix[second, first] = correlation.value
        try:
            return np.asarray(np.linalg.cholesky(matrix), dtype=float)
        except np.linalg.LinAlgError:
            pairs = ", ".join(f"{' and '.join(correlation.between)} {correlation.value:g}" for correlation in correlations)
            raise InputError(self._source, f"correlations contradict each other: {pairs}", "a positive definite matrix") from None


def _truncated_normal(low: float, high: float, mean: float, deviation: float) -> Any:
    return scipy.stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, loc=mean, scale=deviation)


def _or_default(value: float | None, default: float) -> float:
    return default if value is None else value
