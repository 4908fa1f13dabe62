"""Samples vehicles whose characteristics vary as a study states under `[variation]`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import (
    Distribution,
    Fixed,
    Lognormal,
    Normal,
    Triangular,
    Uniform,
    stated_values,
)
from safevar_sumo.vehicles import Characteristic, region_of
from safevar_sumo.vehicles.region import REJECTIONS


class VariationModel:
    """The random variation of a study's characteristics. A characteristic without a distribution
    under `[variation]` varies uniformly over its domain.
    """

    def __init__(self, study: Study) -> None:
        self.region = region_of(study)
        self.characteristics = self.region.characteristics

        self._source = study.source
        self._quantiles = [
            _quantile_function(item, study.variation.get(item.name, Uniform()))
            for item in self.characteristics
        ]

    def settings(self, probabilities: FloatArray) -> FloatArray:
        """The settings with the quantiles at N points of the unit cube, shape (N, n)."""
        columns = [
            quantile(column)
            for quantile, column in zip(self._quantiles, probabilities.T, strict=True)
        ]
        return np.clip(
            np.column_stack(columns),
            self.characteristics.lower,
            self.characteristics.upper,
        )

    def draw(
        self, number: int, rng: np.random.Generator, *, filtered: bool = False
    ) -> FloatArray:
        """Random settings that satisfy the constraints, shape (number, n). With `filtered`, the
        settings satisfy them after the study's filter.
        """
        settings = self.region.draw_feasible(
            lambda count: self.settings(rng.random((count, len(self.characteristics)))),
            number,
            filtered=filtered,
        )
        if len(settings) < number:
            raise InputError(
                self._source,
                f"fewer than 1 in {REJECTIONS} random vehicles satisfy the constraints:"
                f" {self.region}",
                "a [variation] and [[constraints]] that agree",
            )
        return settings


def sampled_in_words(study: Study) -> str:
    """How vehicles are sampled: `sampled uniformly over the whole domain`."""
    if study.variation:
        return "sampled as the study states ([variation])"
    return "sampled uniformly over the whole domain"


def _quantile_function(
    characteristic: Characteristic, distribution: Distribution
) -> Callable[[FloatArray], FloatArray]:
    """The function that turns cumulative probabilities into values in the characteristic's unit."""
    low = characteristic.lower
    high = characteristic.upper
    original = characteristic.original
    stated = stated_values(distribution)
    lower = stated.get("lower", low)
    width = stated.get("upper", high) - lower
    match distribution:
        case Fixed():
            return lambda p: np.full_like(p, stated.get("value", original))
        case Uniform():
            return lambda p: lower + p * width
        case Triangular():
            mode = stated.get("mode", original)
            triangle = scipy.stats.triang((mode - lower) / width, lower, width)
            return lambda p: np.asarray(triangle.ppf(p))
        case Normal():
            mean = stated.get("mean", original)
            deviation = stated["deviation"]
            normal = scipy.stats.truncnorm(
                (low - mean) / deviation, (high - mean) / deviation, mean, deviation
            )
            return lambda p: np.asarray(normal.ppf(p))
        case Lognormal():
            mean = np.log(stated.get("median", original))
            deviation = stated["sigma"]
            ends = (np.log(low) - mean) / deviation, (np.log(high) - mean) / deviation
            logarithm = scipy.stats.truncnorm(*ends, mean, deviation)
            return lambda p: np.exp(logarithm.ppf(p))
