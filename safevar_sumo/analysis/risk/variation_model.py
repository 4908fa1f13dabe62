"""Vehicles as they vary in the world: a study's distributions checked, and settings drawn from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from safevar_sumo.errors import InputError, unknown
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.study.variation import Correlation, Distribution, Fixed, Lognormal, Normal, Triangular, Uniform
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

Quantile = Callable[[FloatArray], FloatArray]
"""From probabilities to values in the characteristic's unit."""

WIDEST = 100
"""Standard deviation of a normal law cut off at the domain, in widths of the domain: beyond, it is uniform to a 20,000th, and at last
its numbers break down."""


class VariationModel:
    """How the characteristics of a study vary.

    Parameters
    ----------
    study
        With its `[variation]` and `[[correlations]]`.

    Raises
    ------
    InputError
        If a distribution or a correlation is impossible; names study, key and what is legal.
    """

    def __init__(self, study: Study) -> None:
        self._members = CharacteristicSet.of(study.vehicle.characteristics)
        self._source = f"study {study.name!r}"
        for name in study.variation:
            if name not in self._members.names:
                raise unknown(self._source, f"variation.{name}: there is no such characteristic", name, self._members.names)
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
                value = self._within(member, "value", law.value, member.original)
                return lambda p: np.full_like(p, value)
            case Uniform() | Triangular():
                lower, upper = self._within(member, "lower", law.lower, low), self._within(member, "upper", law.upper, high)
                if lower >= upper:
                    raise InputError(self._source, f"variation.{member.name}: lower = {lower:g} and upper = {upper:g}", "lower < upper")
                if isinstance(law, Uniform):
                    return lambda p: lower + p * (upper - lower)
                mode = self._within(member, "mode", law.mode, member.original, lower, upper)
                triangle = scipy.stats.triang((mode - lower) / (upper - lower), loc=lower, scale=upper - lower)
                return lambda p: np.asarray(triangle.ppf(p))
            case Normal():
                mean = self._within(member, "mean", law.mean, member.original)
                self._not_wider(member, "deviation", law.deviation, high - low)
                cut = scipy.stats.truncnorm((low - mean) / law.deviation, (high - mean) / law.deviation, loc=mean, scale=law.deviation)
                return lambda p: np.asarray(cut.ppf(p))
            case Lognormal():
                if low <= 0:
                    raise InputError(self._source, f"variation.{member.name}: lognormal, with a domain from {low:g} on", "a domain above 0")
                middle, sigma = np.log(self._within(member, "median", law.median, member.original)), law.sigma
                self._not_wider(member, "sigma", sigma, float(np.log(high / low)))
                logarithm = scipy.stats.truncnorm((np.log(low) - middle) / sigma, (np.log(high) - middle) / sigma, loc=middle, scale=sigma)
                return lambda p: np.exp(logarithm.ppf(p))

    def _within(self, member: Characteristic, key: str, value: float | None, otherwise: float, low: float | None = None,
                high: float | None = None) -> float:
        """A value of a distribution, which must lie in the domain or in narrower limits."""
        low, high = member.lower if low is None else low, member.upper if high is None else high
        chosen = otherwise if value is None else value
        if not low <= chosen <= high:
            raise InputError(self._source, f"variation.{member.name}.{key} = {chosen:g}", f"a number in [{low:g}, {high:g}]{member.suffix}")
        return chosen

    def _not_wider(self, member: Characteristic, key: str, spread: float, width: float) -> None:
        """Refuse a normal law so wide that its part in the domain cannot be told from a uniform one, or be computed."""
        if spread > WIDEST * width:
            raise InputError(self._source, f"variation.{member.name}.{key} = {spread:g}",
                             f"at most {WIDEST * width:g}, {WIDEST} times the domain's width; for more take distribution = \"uniform\"")

    def _cholesky(self, correlations: Sequence[Correlation]) -> FloatArray | None:
        """The factor that makes independent normal variables correlated; None without correlations."""
        if not correlations:
            return None
        names = self._members.names
        matrix = np.eye(len(names))
        given: dict[frozenset[str], float] = {}
        for one in correlations:
            for name in one.between:
                if name not in names:
                    raise unknown(self._source, f"correlations.between: there is no characteristic {name!r}", name, names)
            first, second = (names.index(name) for name in one.between)
            if first == second:
                raise InputError(self._source, f"correlations.between = {list(one.between)}", "two different characteristics")
            pair = frozenset(one.between)
            if pair in given:
                raise InputError(self._source, f"correlations: {one.between[0]} and {one.between[1]} stand twice, "
                                 f"with {given[pair]:g} and {one.value:g}", "each pair once")
            given[pair] = one.value
            matrix[first, second] = matrix[second, first] = one.value
        try:
            return np.asarray(np.linalg.cholesky(matrix), dtype=float)
        except np.linalg.LinAlgError:
            pairs = ", ".join(f"{' and '.join(one.between)} {one.value:g}" for one in correlations)
            raise InputError(self._source, f"correlations contradict each other: {pairs}", "a positive definite matrix") from None
