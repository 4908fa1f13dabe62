"""Vehicles as they vary in the world: settings drawn from a study's distributions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.study.variation import Correlation, Distribution, Fixed, Lognormal, Normal, Triangular, Uniform
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

Quantile = Callable[[FloatArray], FloatArray]
"""From probabilities to values in the characteristic's unit."""


class VariationModel:
    """How the characteristics of a study vary.

    Parameters
    ----------
    study
        With its `[variation]` and `[[correlations]]`.

    Raises
    ------
    InputError
        If the correlations contradict each other.
    """

    def __init__(self, study: Study) -> None:
        self._members = CharacteristicSet.of(study.vehicle.characteristics)
        self._source = f"study {study.name!r}"
        self._quantiles = [self._quantile(member, study.variation.get(member.name, Uniform())) for member in self._members]
        self._factor = self._cholesky(study.correlations)

    @property
    def correlated(self) -> bool:
        return self._factor is not None

    def settings(self, probabilities: FloatArray) -> FloatArray:
        """Settings at points of the unit cube, shape (N, n): independent there, correlated as the study says in the result."""
        if self._factor is not None:
            probabilities = scipy.stats.norm.cdf(scipy.stats.norm.ppf(probabilities) @ self._factor.T)
        columns = [quantile(column) for quantile, column in zip(self._quantiles, probabilities.T, strict=True)]
        return np.clip(np.stack(columns, axis=1), self._members.lower, self._members.upper)

    def _quantile(self, member: Characteristic, law: Distribution) -> Quantile:
        low, high = member.lower, member.upper
        match law:
            case Fixed():
                value = _given(law.value, member.original)
                return lambda p: np.full_like(p, value)
            case Uniform() | Triangular():
                lower, upper = _given(law.lower, low), _given(law.upper, high)
                if isinstance(law, Uniform):
                    return lambda p: lower + p * (upper - lower)
                mode = _given(law.mode, member.original)
                triangle = scipy.stats.triang((mode - lower) / (upper - lower), loc=lower, scale=upper - lower)
                return lambda p: np.asarray(triangle.ppf(p))
            case Normal():
                mean = _given(law.mean, member.original)
                cut = scipy.stats.truncnorm((low - mean) / law.deviation, (high - mean) / law.deviation, loc=mean, scale=law.deviation)
                return lambda p: np.asarray(cut.ppf(p))
            case Lognormal():
                middle, sigma = np.log(_given(law.median, member.original)), law.sigma
                logarithm = scipy.stats.truncnorm((np.log(low) - middle) / sigma, (np.log(high) - middle) / sigma, loc=middle, scale=sigma)
                return lambda p: np.exp(logarithm.ppf(p))

    def _cholesky(self, correlations: Sequence[Correlation]) -> FloatArray | None:
        """The factor that makes independent normal variables correlated; None without correlations."""
        if not correlations:
            return None
        names = self._members.names
        matrix = np.eye(len(names))
        for correlation in correlations:
            first, second = (names.index(name) for name in correlation.between)
            matrix[first, second] = matrix[second, first] = correlation.value
        try:
            return np.asarray(np.linalg.cholesky(matrix), dtype=float)
        except np.linalg.LinAlgError:
            pairs = ", ".join(f"{' and '.join(one.between)} {one.value:g}" for one in correlations)
            raise InputError(self._source, f"correlations contradict each other: {pairs}", "a positive definite matrix") from None


def _given(value: float | None, default: float) -> float:
    return default if value is None else value
