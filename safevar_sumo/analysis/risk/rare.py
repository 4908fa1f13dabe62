"""Probabilities of rare failures in standard normal space: subset simulation and cross-entropy importance sampling, by
OpenTURNS.

Au and Beck, Estimation of small failure probabilities in high dimensions by subset simulation, Probabilistic
Engineering Mechanics 16 (2001); Rubinstein and Kroese, The cross-entropy method (2004).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.risk.answer import Estimate
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray

LEVEL_SHARE = 0.1
"""p0: the next level starts from this share of a level's vehicles, those nearest to failure."""
LEVEL_SIZE = 1000
"""N: number of vehicles of a level. A block has p0 N vehicles, so that no vehicle continues from another vehicle of its
block.
"""
REPEATS, VERY_RARE_REPEATS = 4, 8
"""Number of independent repeats of a method; more of a subset simulation for very rare failures."""
VERY_RARE_BELOW = 3e-4
"""Failures are very rare below this probability."""

INFLATION = 1.3
"""Factor on OpenTURNS' coefficient of variation, which wrongly assumes that the levels of a subset simulation are
independent. In 240 repeats with linear limit states (probability 1e-3 to 1e-6, 5 to 12 dimensions) the observed
coefficients were 1.1 to 1.3 times as large.
"""
PRIOR_DEGREES = 3
"""The interval has so many more degrees of freedom than repeats, for the information in OpenTURNS' own estimates."""
MIN_PROBABILITY = 1e-10
"""Probability at which a subset simulation gives up."""
PROPOSAL_WIDTH = 2.0
"""Width of the uniform proposals of a subset simulation's Markov chains."""
SAFE_RESPONSE = 1e6
"""Response where the safety degree is undefined or the simulation failed; it stands for the greatest distance from
failure.
"""
MIN_RESPONSE = 1e-9
"""Smallest absolute value of a response, so that its sign always shows whether the vehicle is unsafe."""
PLATEAU_SHARE = 0.5
"""The response is a plateau if at least this share of the vehicles nearest to failure have the same response."""
PLATEAU = "the response is a plateau before failures, which methods for rare failures cannot cross"
SEARCH_SETTINGS = 100
"""Number of settings around the design point in each round of its search."""
SEARCH_ROUNDS = 4
"""Number of these rounds."""


class RareMethodError(Exception):
    """A method for rare failures does not find its way to a failure; the text says why."""


class Response:
    """The response g(u) at a point u of standard normal space, below 0 where the vehicle is unsafe.

    Attributes
    ----------
    settings_of
        Turns points into settings.
    samples, failures, errors
        Number of vehicles that could be simulated, of unsafe ones among them, and of those that could not be simulated.
    nearest_failure
        The failure nearest to the origin so far, shape (1, n), or (0, n) if there is none.
    """

    def __init__(self, evaluator: Evaluator, settings_of: Callable[[FloatArray], FloatArray], unsafe: Unsafe) -> None:
        self.evaluator, self.settings_of, self._unsafe = evaluator, settings_of, unsafe
        self.dimensions = len(evaluator.characteristics)
        self.samples = self.failures = self.errors = 0
        self.nearest_failure = np.zeros((0, self.dimensions))

    def __call__(self, points: Any) -> FloatArray:
        """The response at points, shape (N, n)."""
        array = np.asarray(points, dtype=float).reshape(-1, self.dimensions)
        return self.record(array, self.evaluator.evaluate(self.settings_of(array), "rare failures"))

    def record(self, points: FloatArray, evaluations: Evaluations) -> FloatArray:
        """The response at points whose evaluations are known; these are counted, too."""
        is_unsafe, margin = self._unsafe.of(evaluations), self._unsafe.margin(evaluations)
        response = np.where(evaluations.valid & ~np.isnan(margin), margin, SAFE_RESPONSE)
        self.samples += int(np.count_nonzero(evaluations.valid))
        self.errors += int(np.count_nonzero(~evaluations.valid))
        self.failures += int(np.count_nonzero(is_unsafe))
        failures = np.concatenate([self.nearest_failure, points[is_unsafe]])
        self.nearest_failure = failures[np.argsort(np.linalg.norm(failures, axis=1), kind="stable")[:1]]
        return np.where(is_unsafe, np.minimum(response, -MIN_RESPONSE), np.maximum(response, MIN_RESPONSE))


def load_openturns() -> Any:
    """The module openturns, with its messages switched off.

    Raises
    ------
    InputError
        If OpenTURNS is not installed.
    """
    try:
        import openturns
    except ImportError:
        remedy = "in the checkout: pip install '.[rare]'; or `method=monte_carlo`"
        raise InputError("method", "OpenTURNS is not installed", remedy) from None
    openturns.Log.Show(openturns.Log.NONE)
    return openturns


def is_plateau(responses: FloatArray) -> bool:
    """Whether most of the safe responses nearest to failure (a share p0 of all) equal each other, or the safety degree
    is undefined for one of them.
    """
    nearest = np.sort(responses[responses > 0])[: max(int(LEVEL_SHARE * len(responses)), 2)]
    if not len(nearest):
        return False
    highest = nearest[-1]
    return bool(np.count_nonzero(nearest == highest) >= PLATEAU_SHARE * len(nearest) or highest >= SAFE_RESPONSE)


def estimate_rare(response: Response, method: str, confidence: float) -> Estimate:
    """Estimate the probability that a response is below 0, by "subset_simulation" or "cross_entropy".

    Raises
    ------
    RareMethodError
        If the response does not show which vehicles are nearer to failure, or cross-entropy sampling loses all
        failures.
    """
    seed, estimates = response.evaluator.study.search.seed, list[tuple[float, float]]()
    # Without a failure, the interval is that of the independent vehicles that the response has simulated so far.
    interval = clopper_pearson(response.failures, response.samples, confidence)
    remark = (
        f"the method found no failure: either there is none, or the response does not lead to it; the interval is "
        f"that of the first {response.samples} vehicles"
    )
    repeats, is_subset = REPEATS, method == "subset_simulation"
    estimate_once = _run_subset_simulation if is_subset else _run_cross_entropy
    while len(estimates) < repeats:
        estimates.append(estimate_once(response, (seed + 7919 * len(estimates)) % 2**31))  # seeds differ by a prime
        probabilities, coefficients = np.array(estimates).T
        mean = float(np.mean(probabilities))
        if len(estimates) == REPEATS and is_subset and mean < VERY_RARE_BELOW:
            repeats = VERY_RARE_REPEATS
    failures, errors = response.failures, response.errors  # before the search for the design point
    coefficient_of_variation, design_point = math.nan, None
    if mean > 0:
        observed = float(np.std(probabilities, ddof=1)) / mean / math.sqrt(repeats)
        estimated = INFLATION * math.sqrt(float(np.mean(np.square(coefficients))) / repeats)
        coefficient_of_variation = max(observed, estimated)
        quantile = float(scipy.stats.t.ppf((1 + confidence) / 2, repeats + PRIOR_DEGREES))
        factor = math.exp(quantile * math.sqrt(math.log1p(coefficient_of_variation**2)))
        interval = (mean / factor, min(mean * factor, 1.0))
        remark = ""
        (setting,) = response.settings_of(_find_design_point(response, np.random.default_rng(seed))).tolist()
        design_point = dict(zip(response.evaluator.characteristics.names, setting, strict=True))
    return Estimate(
        probability=max(mean, 0.0),
        coefficient_of_variation=coefficient_of_variation,
        interval=interval,
        samples=response.samples + response.errors - errors,
        failures=failures,
        errors=errors,
        method=method,
        design_point=design_point,
        remark=remark,
    )


def _failure_event(ot: Any, response: Callable[[Any], FloatArray], dimensions: int) -> Any:
    function = ot.PythonFunction(dimensions, 1, func_sample=lambda points: response(points)[:, np.newaxis])
    return ot.ThresholdEvent(ot.CompositeRandomVector(function, ot.RandomVector(ot.Normal(dimensions))), ot.Less(), 0.0)


def _run_subset_simulation(response: Response, seed: int) -> tuple[float, float]:
    """Probability and coefficient of variation of a subset simulation."""
    ot = load_openturns()
    is_stagnant = False
    algorithm = ot.SubsetSampling(_failure_event(ot, response, response.dimensions), PROPOSAL_WIDTH, LEVEL_SHARE)
    algorithm.setBlockSize(round(LEVEL_SHARE * LEVEL_SIZE))
    algorithm.setMaximumOuterSampling(round(1 / LEVEL_SHARE))
    algorithm.setMaximumCoefficientOfVariation(-1.0)
    algorithm.setMinimumProbability(MIN_PROBABILITY)

    def level_stagnates() -> bool:
        nonlocal is_stagnant
        thresholds = list(algorithm.getThresholdPerStep())
        is_stagnant = len(thresholds) > 1 and thresholds[-1] > 0 and thresholds[-1] == thresholds[-2]
        return is_stagnant

    algorithm.setStopCallback(level_stagnates)
    ot.RandomGenerator.SetSeed(seed)
    try:
        algorithm.run()
    except TypeError as error:  # OpenTURNS estimates a level's variance as a difference, which can fall below 0
        if "variance estimate" not in str(error):
            raise
        return _run_subset_simulation(response, seed + 1)
    except RuntimeError as error:  # the probability of a level is below MIN_PROBABILITY
        if "estimate too small" not in str(error):
            raise
        return 0.0, 0.0
    if is_stagnant:
        raise RareMethodError(PLATEAU)
    if algorithm.getThresholdPerStep()[-1] > 0:
        return 0.0, 0.0
    result = algorithm.getResult()
    return float(result.getProbabilityEstimate()), float(result.getCoefficientOfVariation())


def _run_cross_entropy(response: Response, seed: int) -> tuple[float, float]:
    """Probability and coefficient of variation by cross-entropy importance sampling with independent normal
    variables.
    """
    ot = load_openturns()
    algorithm = ot.StandardSpaceCrossEntropyImportanceSampling(
        _failure_event(ot, response, response.dimensions), 2 * LEVEL_SHARE
    )
    algorithm.setBlockSize(LEVEL_SIZE)
    algorithm.setMaximumOuterSampling(1)
    algorithm.setMaximumCoefficientOfVariation(-1.0)
    ot.RandomGenerator.SetSeed(seed)
    try:
        algorithm.run()
    except RuntimeError as error:
        if "sumPdfCritic is equal to zero" not in str(error):
            raise
        raise RareMethodError("cross-entropy sampling lost all failures") from None
    result = algorithm.getResult()
    probability = float(result.getProbabilityEstimate())
    return probability, float(result.getCoefficientOfVariation()) if probability > 0 else 0.0


def _find_design_point(response: Response, rng: np.random.Generator) -> FloatArray:
    """The failure nearest to the origin, which is sought between the nearest known failure and the origin, and around
    the nearest known failure.
    """
    for search_round in range(SEARCH_ROUNDS):
        nearest = response.nearest_failure
        nearer = nearest * (1 - 0.05 * rng.random((SEARCH_SETTINGS, 1)))
        deviations = rng.normal(size=(SEARCH_SETTINGS, response.dimensions)) * 0.4 / 2**search_round
        response(nearest * np.linspace(0.5, 1.0, SEARCH_SETTINGS)[:, np.newaxis])
        response(nearer + deviations)
    return response.nearest_failure
