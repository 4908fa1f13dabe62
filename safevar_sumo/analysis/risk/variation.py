"""How vehicles vary: the random variation of a study's characteristics."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import scipy

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import Distribution, Fixed, Lognormal, Normal, Triangular, Uniform
from safevar_sumo.vehicles import Characteristic, FeasibleRegion, region_of
from safevar_sumo.vehicles.region import REJECTIONS


class VariationModel:
    """The random variation of a study's characteristics, by its `[variation]` and `[[correlations]]`.

    Raises
    ------
    InputError
        If the correlations contradict each other.
    """

    def __init__(self, study: Study) -> None:
        self.region: FeasibleRegion = region_of(study)
        self.characteristics = self.region.characteristics
        distributions = [study.variation.get(name, Uniform()) for name in self.characteristics.names]
        self.varying = np.array([not isinstance(distribution, Fixed) for distribution in distributions])
        self._quantiles = list(map(_quantile_function, self.characteristics, distributions))
        self.is_correlated, self.correlation = bool(study.correlations), np.eye(len(distributions))
        for correlation in study.correlations:
            first, second = map(self.characteristics.names.index, correlation.between)
            self.correlation[first, second] = self.correlation[second, first] = correlation.value
        try:
            self._factor = np.linalg.cholesky(self.correlation)
        except np.linalg.LinAlgError:
            pairs = ", ".join(f"{' and '.join(one.between)} {one.value:g}" for one in study.correlations)
            problem = f"correlations contradict each other: {pairs}"
            raise InputError(study.source, problem, "a positive definite matrix") from None

    def settings(self, probabilities: FloatArray) -> FloatArray:
        """Settings at N independent points of the unit cube, shape (N, n), correlated as the study specifies."""
        if self.is_correlated:
            return self.settings_of_normal(scipy.stats.norm.ppf(probabilities))
        return self.settings_at(probabilities)

    def settings_of_normal(self, points: FloatArray) -> FloatArray:
        """Settings at N points of standard normal space, shape (N, n), correlated as the study specifies."""
        return self.settings_at(scipy.stats.norm.cdf(points @ self._factor.T if self.is_correlated else points))

    def settings_at(self, probabilities: FloatArray) -> FloatArray:
        """Settings whose values have these probabilities, shape (N, n), which have the study's correlations already."""
        columns = [quantile(column) for quantile, column in zip(self._quantiles, probabilities.T, strict=True)]
        return np.clip(np.stack(columns, axis=1), self.characteristics.lower, self.characteristics.upper)

    def draw(self, number: int, rng: np.random.Generator, source: object) -> FloatArray:
        """Random vehicles that satisfy the constraints, shape (number, n)."""
        settings = self.region.draw_feasible(
            lambda count: self.settings(rng.random((count, len(self.characteristics)))), number
        )
        if len(settings) < number:
            raise InputError(
                source,
                f"fewer than 1 in {REJECTIONS} random vehicles satisfy the constraints: {self.region}",
                "a [variation] and [[constraints]] that agree",
            )
        return settings


def _quantile_function(
    characteristic: Characteristic, distribution: Distribution
) -> Callable[[FloatArray], FloatArray]:
    """Turns probabilities into values in the characteristic's unit."""
    low, high, original = characteristic.lower, characteristic.upper, characteristic.original
    stated = {name: value for name, value in msgspec.structs.asdict(distribution).items() if value is not None}
    match distribution:
        case Fixed():
            return lambda p: np.full_like(p, stated.get("value", original))
        case Uniform() | Triangular():
            lower, upper = stated.get("lower", low), stated.get("upper", high)
            if isinstance(distribution, Uniform):
                return lambda p: lower + p * (upper - lower)
            triangle = scipy.stats.triang(
                (stated.get("mode", original) - lower) / (upper - lower), lower, upper - lower
            )
            return lambda p: triangle.ppf(p)
        case Normal():
            mean, deviation = stated.get("mean", original), stated["deviation"]
            normal = scipy.stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, mean, deviation)
            return lambda p: normal.ppf(p)
        case Lognormal():
            mean, deviation = np.log(stated.get("median", original)), stated["sigma"]
            ends = (np.log(low) - mean) / deviation, (np.log(high) - mean) / deviation
            logarithm = scipy.stats.truncnorm(*ends, mean, deviation)
            return lambda p: np.exp(logarithm.ppf(p))
