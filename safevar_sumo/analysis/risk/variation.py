"""Vehicles that vary as a study's [variation] and [[correlations]] specify, and which characteristic decides: Sobol
indices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import Correlation, Distribution, Fixed, Lognormal, Normal, Triangular, Uniform
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, in the design for Sobol indices of unsafe outcomes."""
BOOTSTRAP_SAMPLES = 200
"""Number of bootstrap samples for the intervals."""
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
        self._quantiles = [
            self._quantile_function(characteristic, study.variation.get(characteristic.name, Uniform()))
            for characteristic in self._characteristics
        ]
        self._factor = self._correlating_factor(study.correlations)

    @property
    def is_correlated(self) -> bool:
        return self._factor is not None

    def settings(self, probabilities: FloatArray) -> FloatArray:
        """Settings at N independent points of the unit cube, shape (N, n); the settings are correlated as the study
        specifies.
        """
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
            pairs = ", ".join(
                f"{' and '.join(correlation.between)} {correlation.value:g}" for correlation in correlations
            )
            raise InputError(
                self._source, f"correlations contradict each other: {pairs}", "a positive definite matrix"
            ) from None


def _truncated_normal(low: float, high: float, mean: float, deviation: float) -> Any:
    return scipy.stats.truncnorm((low - mean) / deviation, (high - mean) / deviation, loc=mean, scale=deviation)


def _or_default(value: float | None, default: float) -> float:
    return default if value is None else value


def compute_sensitivities(
    evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, confidence: float
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Sensitivity of the safety degree, and of the unsafe outcome.

    Returns
    -------
    tuple of pandas.DataFrame
        One row per characteristic: `characteristic`, `first_order`, `total` [share of the variance], and the intervals'
        ends `first_order_lower`, `first_order_upper`, `total_lower`, `total_upper`; NaN where nothing varies, or too
        few settings are unsafe (or safe).
    """
    from SALib.sample import sobol  # takes a second to load

    seed, names = evaluator.study.search.seed % 2**32, evaluator.characteristics.names
    problem = {"num_vars": len(names), "names": list(names), "bounds": [[0.0, 1.0]] * len(names)}
    points = sobol.sample(problem, BASE_POINTS, calc_second_order=False, seed=seed)
    evaluations = evaluator.evaluate(model.settings(np.asarray(points)), "sensitivity analysis")
    degree = np.where(evaluations.valid, evaluations.f_safe, np.nan)
    is_unsafe = np.where(evaluations.valid, unsafe.of(evaluations).astype(float), np.nan)
    if min(np.count_nonzero(is_unsafe == outcome) for outcome in (0, 1)) < MIN_OUTCOMES:
        is_unsafe[:] = np.nan
    return _sobol_indices(problem, degree, confidence, seed), _sobol_indices(problem, is_unsafe, confidence, seed)


def _sobol_indices(problem: dict[str, Any], output: FloatArray, confidence: float, seed: int) -> pd.DataFrame:
    """Sobol indices of an output over the design, without base points at which the output is undefined for any
    setting.
    """
    from SALib.analyze import sobol

    blocks = output.reshape(BASE_POINTS, -1)
    outputs = blocks[np.isfinite(blocks).all(axis=1)].ravel()
    names = problem["names"]
    if not outputs.size or np.ptp(outputs) == 0:
        indices = {name: np.full(len(names), np.nan) for name in ("S1", "ST", "S1_conf", "ST_conf")}
    else:
        indices = sobol.analyze(
            problem, outputs, calc_second_order=False, num_resamples=BOOTSTRAP_SAMPLES, conf_level=confidence, seed=seed
        )
    frame = pd.DataFrame({"characteristic": names, "first_order": indices["S1"], "total": indices["ST"]})
    for name, key in (("first_order", "S1"), ("total", "ST")):
        for end, sign in (("lower", -1), ("upper", 1)):
            frame[f"{name}_{end}"] = frame[name] + sign * indices[f"{key}_conf"]
    return frame
