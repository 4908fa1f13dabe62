"""How the characteristics of vehicles vary, and which of them decide: the share of each in a variance, as Sobol indices
or, if characteristics are correlated or constrained, as Shapley effects.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import permutations
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import Evaluator, sobol_points
from safevar_sumo.analysis.risk.answer import SHAPLEY, SOBOL, UNSAFE, effect_columns
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.study.characteristics import (
    Distribution,
    Fixed,
    Lognormal,
    Normal,
    Triangular,
    Uniform,
    stated_values,
)
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
            pairs = ", ".join(f"{' and '.join(pair.between)} {pair.value:g}" for pair in study.correlations)
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
        """Settings whose values have these cumulative probabilities, shape (N, n); the correlations are in them."""
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
    """The function that turns cumulative probabilities into values in the characteristic's unit."""
    low, high, original = characteristic.lower, characteristic.upper, characteristic.original
    stated = stated_values(distribution)
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


BASE_POINTS = 512
"""Number of base points of Saltelli's design, which has n + 2 settings for each base point."""
BOOTSTRAP_SAMPLES = 200
"""Number of bootstrap samples for the intervals of Sobol indices."""
PERMUTATIONS = 2048
"""Number of permutations; each takes 1 + `DRAWS` (n - 1) settings of n characteristics that vary."""
DRAWS = 3
"""Number of conditional draws for each conditional variance, as Song, Nelson and Staum recommend."""
MIN_OUTCOMES = 100
"""Minimum number of unsafe settings, and of safe settings, in a design for indices of the unsafe outcome."""
SMALLEST_PROBABILITY = 1e-12
"""Probabilities of Sobol points are at least this far from 0 and 1, so that their normal values are finite."""


def compute_effects(evaluator: Evaluator, model: VariationModel, unsafe: Unsafe, confidence: float) -> pd.DataFrame:
    """Compute what decides the safety degree, and the unsafe outcome: the frame `Risk.effects`.

    Notes
    -----
    The Shapley effect of a characteristic is the mean, over the orders in which the characteristics may join a set J,
    of the growth of c(J) = E[Var(Y | the others)] when it joins (Song, Nelson, Staum 2016, SIAM/ASA J. Uncertainty
    Quantification 4, 1060-1083). Orders are drawn at random, or all taken equally often if there are few. Values of
    J given the others are drawn by the Gaussian copula, and drawn again where they violate a constraint. Sobol points
    replace random numbers, the same for all sets of an order. The linear regression on the normal values behind the
    settings is a control variate, because its conditional variances are known; with constraints they are not, and no
    control variate is used.
    """
    seed, names = evaluator.study.search.seed, evaluator.characteristics.names
    indices: tuple[str, ...]
    if model.is_correlated or model.region:
        indices, stage, design = SHAPLEY, "Shapley effects", _design(model, seed)
        settings = design.settings.reshape(-1, len(names))
        effects_on = partial(_shapley_effects, design, model.varying, confidence)
    else:
        from SALib.sample import sobol  # takes a second to load

        indices, stage, problem = SOBOL, "sensitivity analysis", {"num_vars": len(names), "names": list(names)}
        problem["bounds"] = [[0.0, 1.0]] * len(names)
        settings = model.settings(sobol.sample(problem, BASE_POINTS, calc_second_order=False, seed=seed % 2**32))
        effects_on = partial(_sobol_indices, problem, confidence, seed % 2**32)
    evaluations = evaluator.evaluate(settings, stage)
    degree = np.where(evaluations.valid, evaluations.f_safe, np.nan)
    is_unsafe = np.where(evaluations.valid, unsafe.of(evaluations).astype(float), np.nan)
    if min(np.count_nonzero(is_unsafe == outcome) for outcome in (0, 1)) < MIN_OUTCOMES:
        is_unsafe[:] = np.nan
    frames = [
        pd.DataFrame({"output": name, "characteristic": names, **effects_on(output)}, columns=effect_columns(indices))
        for name, output in ((SAFETY_DEGREE, degree), (UNSAFE, is_unsafe))
    ]
    return pd.concat(frames, ignore_index=True)


def _sobol_indices(
    problem: JsonObject, confidence: float, seed: int, output: FloatArray
) -> dict[str, FloatArray | float]:
    """Sobol indices of an output over the design; base points with a setting whose output is undefined do not count."""
    from SALib.analyze import sobol

    blocks = output.reshape(BASE_POINTS, -1)
    outputs = blocks[np.isfinite(blocks).all(axis=1)].ravel()
    if not outputs.size or np.ptp(outputs) == 0:
        return dict.fromkeys(effect_columns(SOBOL)[2:], np.nan)
    analysis = sobol.analyze(
        problem, outputs, calc_second_order=False, num_resamples=BOOTSTRAP_SAMPLES, conf_level=confidence, seed=seed
    )
    columns = dict[str, FloatArray | float]()
    for name, key in (("first_order", "S1"), ("total", "ST")):
        index, half_width = analysis[key], analysis[f"{key}_conf"]
        columns |= {name: index, f"{name}_lower": index - half_width, f"{name}_upper": index + half_width}
    return columns


class Design(NamedTuple):
    """The settings from which Shapley effects are estimated; d of the n characteristics vary.

    Attributes
    ----------
    orders
        M orders in which the d characteristics join, shape (M, d).
    settings
        1 + (d - 1) `DRAWS` settings for each order, shape (M, 1 + (d - 1) `DRAWS`, n): a random one, then `DRAWS`
        settings for each set of the order's first 1, 2, ..., d - 1 characteristics. In these only the set's values
        are drawn anew, given the other values of the random setting.
    latent
        The correlated normal values behind the settings, shape (M, 1 + (d - 1) `DRAWS`, d).
    sets
        For each set: the rows of the orders that begin with it, which characteristics it has, and the covariance of
        its normal values given the others. The last set is that of all. Empty if constraints make the covariances
        unknown.
    """

    orders: np.ndarray
    settings: FloatArray
    latent: FloatArray
    sets: list[tuple[np.ndarray, BoolArray, FloatArray]]


def _design(model: VariationModel, seed: int) -> Design:
    varying, region = model.varying, model.region
    d, rng = int(varying.sum()), np.random.default_rng(seed)
    orders = _orders(d, rng)
    probabilities = sobol_points(PERMUTATIONS, max(1, (1 + DRAWS) * d), seed)[:, : (1 + DRAWS) * d]
    normal = scipy.stats.norm.ppf(np.clip(probabilities, SMALLEST_PROBABILITY, 1 - SMALLEST_PROBABILITY))
    normal = normal.reshape(PERMUTATIONS, 1 + DRAWS, d)
    correlation = model.correlation[np.ix_(varying, varying)]

    def settings_of(latent: FloatArray) -> FloatArray:
        points = np.zeros((*latent.shape[:-1], len(varying)))
        points[..., varying] = latent
        probabilities = scipy.stats.norm.cdf(points.reshape(-1, len(varying)))
        return model.settings_at(probabilities).reshape(points.shape)

    def redraw(latent: FloatArray, mean: FloatArray, factor: FloatArray, in_set: BoolArray) -> None:
        """Draw the set's values of K points, shape (K, d), again where they violate a constraint."""
        if not region:
            return
        for _ in range(REJECTIONS):
            violates = ~region.feasible(settings_of(latent))
            if not violates.any():
                return
            normal = rng.standard_normal((int(violates.sum()), len(factor)))
            latent[np.ix_(violates, in_set)] = mean[violates] + normal @ factor.T

    factor = np.linalg.cholesky(correlation)
    base, in_all = normal[:, 0] @ factor.T, np.ones(d, dtype=bool)
    redraw(base, np.zeros_like(base), factor, in_all)
    latent = np.repeat(base[:, np.newaxis], 1 + max(0, d - 1) * DRAWS, axis=1)
    sets = []
    for size in range(1, d):
        has_joined = np.zeros((PERMUTATIONS, d), dtype=bool)
        np.put_along_axis(has_joined, orders[:, :size], True, axis=1)
        for in_set in np.unique(has_joined, axis=0):
            rows = np.flatnonzero((has_joined == in_set).all(axis=1))
            others = ~in_set
            weights = np.linalg.solve(correlation[np.ix_(others, others)], correlation[np.ix_(others, in_set)])
            covariance = correlation[np.ix_(in_set, in_set)] - correlation[np.ix_(in_set, others)] @ weights
            factor = np.linalg.cholesky(covariance)
            mean = np.repeat(base[rows][:, others] @ weights, DRAWS, axis=0)
            points = np.repeat(base[rows], DRAWS, axis=0)
            points[:, in_set] = mean + normal[rows, 1:][:, :, in_set].reshape(len(mean), -1) @ factor.T
            redraw(points, mean, factor, in_set)
            start = 1 + (size - 1) * DRAWS
            latent[rows, start : start + DRAWS] = points.reshape(len(rows), DRAWS, d)
            sets.append((rows, in_set, covariance))
    settings = settings_of(latent)
    if region:  # a draw that found no feasible values keeps those of the setting that it varies
        is_feasible = region.feasible(settings.reshape(-1, len(varying))).reshape(settings.shape[:2])
        settings = np.where(is_feasible[..., np.newaxis], settings, settings[:, :1])
    sets.append((np.arange(PERMUTATIONS), in_all, correlation))
    return Design(orders, settings, latent, [] if region else sets)


def _orders(d: int, rng: np.random.Generator) -> np.ndarray:
    """`PERMUTATIONS` orders of d characteristics: half of them, then the reverse of each.

    All possible orders occur equally often; the rest, or all if there are too many possible ones, is drawn at random.
    """
    half, number = PERMUTATIONS // 2, math.factorial(d)
    systematic = list(permutations(range(d))) * (half // number) if number <= half else []
    drawn = rng.permuted(np.tile(np.arange(d), (half - len(systematic), 1)), axis=1)
    systematic_rows = np.array(systematic, dtype=np.intp).reshape(len(systematic), d)
    orders = rng.permutation(np.concatenate([systematic_rows, drawn]))
    return np.concatenate([orders, orders[:, ::-1]])


def _shapley_effects(
    design: Design, varying: BoolArray, confidence: float, output: FloatArray
) -> dict[str, FloatArray | float]:
    """Shapley effects on an output of the design; orders with a setting whose output is undefined do not count."""
    values = output.reshape(design.latent.shape[:2])
    is_complete = np.isfinite(values).all(axis=1)
    values, orders, latent = values[is_complete], design.orders[is_complete], design.latent[is_complete]
    if len(values) < 2 or np.ptp(values) == 0 or not varying.any():
        return dict.fromkeys(effect_columns(SHAPLEY)[2:], np.nan)
    number, variances = len(values), _variances(values)
    if design.sets:
        # The last coefficient is the intercept.
        slopes = np.linalg.lstsq(np.column_stack([latent[:, 0], np.ones(number)]), values[:, 0], rcond=None)[0][:-1]
        exact = np.zeros(design.orders.shape)
        for rows, in_set, covariance in design.sets:
            exact[rows, np.count_nonzero(in_set) - 1] = slopes[in_set] @ covariance @ slopes[in_set]
        error = _variances(latent @ slopes) - exact[is_complete]
        factor = np.sum(error * (variances - exact[is_complete])) / max(np.sum(error**2), np.finfo(float).tiny)
        variances = variances - factor * error
    contributions = np.zeros((number, len(varying)))
    growth = np.diff(variances, axis=1, prepend=0.0)
    np.put_along_axis(contributions, np.flatnonzero(varying)[orders], growth, axis=1)
    effect, variance = contributions.mean(axis=0), float(variances[0, -1])
    half_width = scipy.stats.norm.ppf((1 + confidence) / 2) * contributions.std(axis=0, ddof=1) / math.sqrt(number)
    columns = {"share": effect, "share_lower": effect - half_width, "share_upper": effect + half_width}
    return {"effect": effect, **{name: column / variance for name, column in columns.items()}}


def _variances(values: FloatArray) -> FloatArray:
    """For each order the conditional variances of its first 1, 2, ..., d - 1 characteristics, then the whole
    variance.
    """
    draws = values[:, 1:].reshape(len(values), (values.shape[1] - 1) // DRAWS, DRAWS)
    whole = np.full((len(values), 1), values[:, 0].var(ddof=1))
    return np.concatenate([draws.var(axis=2, ddof=1), whole], axis=1)
