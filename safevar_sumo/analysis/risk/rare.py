"""Probabilities of rare failures in standard normal space: subset simulation and cross-entropy importance sampling, by
OpenTURNS.

Au and Beck, Estimation of small failure probabilities in high dimensions by subset simulation, Probabilistic
Engineering Mechanics 16 (2001); Rubinstein and Kroese, The cross-entropy method (2004).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.risk.answer import Estimate
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, Evaluations, FloatArray

LEVEL_SHARE = 0.1
"""p0: share of a level's vehicles (those nearest to failure) from which the next level starts."""
LEVEL_SIZE = 1000
"""N: number of vehicles of a level. A block has p0 N vehicles, so that no vehicle continues from another vehicle of its
block.
"""
REPEATS, VERY_RARE_REPEATS = 4, 8
"""Number of independent repeats for probabilities of at least `VERY_RARE_BELOW`, and for lower probabilities."""
VERY_RARE_BELOW = 3e-4
INFLATION = 1.3
"""Factor on OpenTURNS' coefficient of variation, which wrongly assumes that the levels of a subset simulation are
independent. In 240 repeats with linear limit states (probability 1e-3 to 1e-6, 5 to 12 dimensions) the observed
coefficients were 1.1 to 1.3 times as large.
"""
PRIOR_DEGREES = 3
"""Degrees of freedom of the interval in addition to the number of repeats, for the information in OpenTURNS' own
estimates.
"""
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
PATH_POINTS = 9
"""Number of points evaluated on the straight path between two failures."""
COMPARED_FAILURES = 14
"""Maximum number of failures that are compared pairwise."""
SEARCH_SETTINGS = 100
"""Number of settings around the design point in each round of its search."""
SEARCH_ROUNDS = 4
SettingsFunction = Callable[[FloatArray], FloatArray]
"""Turns points of standard normal space into settings."""


class RareMethodError(Exception):
    """A method for rare failures does not find its way to a failure; the text says why."""


class Response:
    """The response g(u) at a point u of standard normal space, below 0 where the vehicle is unsafe; counts simulations,
    stores failures.
    """

    def __init__(self, evaluator: Evaluator, settings_of: SettingsFunction, unsafe: Unsafe) -> None:
        self._evaluator, self._settings_of, self._unsafe = evaluator, settings_of, unsafe
        self.dimensions = len(evaluator.characteristics)
        self.simulations = self.errors = self.failure_count = 0
        self.stage = "rare failures"
        self.expected_simulations = 1
        self._failure_batches: list[FloatArray] = []
        """Points of unsafe vehicles in each call, shape (k, n) each."""

    @property
    def failure_points(self) -> FloatArray:
        """Distinct points of unsafe vehicles, shape (k, n)."""
        return np.unique(np.concatenate([np.zeros((0, self.dimensions)), *self._failure_batches]), axis=0)

    def values_at(self, point: FloatArray | None) -> dict[str, float] | None:
        """The values of the vehicle at a point by characteristic."""
        if point is None:
            return None
        setting = self._settings_of(point[np.newaxis])[0].tolist()
        return dict(zip(self._evaluator.characteristics.names, setting, strict=True))

    def __call__(self, points: Any) -> FloatArray:
        """The response at points, shape (N, n)."""
        array = np.asarray(points, dtype=float).reshape(-1, self.dimensions)
        total = max(self.expected_simulations, self.simulations + len(array))
        evaluations = self._evaluator.evaluate(self._settings_of(array), self.stage, self.simulations, total)
        return self.record(array, evaluations)

    def record(self, points: FloatArray, evaluations: Evaluations) -> FloatArray:
        """Count known evaluations of points, store the failures among the points, and return the response."""
        is_unsafe = self._unsafe.of(evaluations)
        margin = self._unsafe.margin(evaluations)
        margin = np.where(evaluations.valid & ~np.isnan(margin), margin, SAFE_RESPONSE)
        self.simulations += len(points)
        self.errors += int(np.count_nonzero(~evaluations.valid))
        self.failure_count += int(np.count_nonzero(is_unsafe))
        self._failure_batches.append(points[is_unsafe])
        return np.where(is_unsafe, np.minimum(margin, -MIN_RESPONSE), np.maximum(margin, MIN_RESPONSE))


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
    """Whether most of the responses nearest to failure (a share p0 of all) equal each other."""
    nearest = np.sort(responses[responses > 0])[: max(int(LEVEL_SHARE * len(responses)), 2)]
    if not len(nearest):
        return False
    return bool(
        np.count_nonzero(nearest == nearest[-1]) >= PLATEAU_SHARE * len(nearest) or nearest[-1] >= SAFE_RESPONSE
    )


def estimate_rare(response: Response, method: str, confidence: float, seed: int) -> Estimate:
    """Estimate the probability that a response is below 0.

    Parameters
    ----------
    method
        "subset_simulation" or "cross_entropy".

    Raises
    ------
    RareMethodError
        If the response does not show which vehicles are nearer to failure, or cross-entropy sampling loses all
        failures.
    """
    estimate_once = _run_subset_simulation if method == "subset_simulation" else _run_cross_entropy
    probabilities, variations, thresholds = [], [], list[float]()
    repeats, completed = REPEATS, 0
    response.expected_simulations = response.simulations + 4 * REPEATS * LEVEL_SIZE
    with _restore_generator():
        while completed < repeats:
            response.stage = f"rare failures, repeat {completed + 1} of {repeats}"
            probability, variation, thresholds = estimate_once(response, (seed + 7919 * completed) % 2**31)
            probabilities.append(probability)
            variations.append(variation)
            completed += 1
            if completed == REPEATS and method == "subset_simulation" and np.mean(probabilities) < VERY_RARE_BELOW:
                repeats = VERY_RARE_REPEATS
                response.expected_simulations = response.simulations * repeats // REPEATS
    mean, design_point = float(np.mean(probabilities)), None
    variation, interval, rng = math.nan, (0.0, MIN_PROBABILITY), np.random.default_rng(seed)
    remark = "no failure was found: either there is none, or the response does not lead to it"
    if mean > 0:
        spread = float(np.std(probabilities, ddof=1)) / mean / math.sqrt(repeats)
        variation = max(spread, INFLATION * math.sqrt(float(np.mean(np.square(variations))) / repeats))
        quantile = float(scipy.stats.t.ppf((1 + confidence) / 2, repeats + PRIOR_DEGREES))
        factor = math.exp(quantile * math.sqrt(math.log1p(variation**2)))
        interval = (mean / factor, min(mean * factor, 1.0))
        remark = _remark_on_islands(response, thresholds, rng)
    failures, errors = response.failure_count, response.errors  # without those around the design point
    if mean > 0:
        design_point = response.values_at(_find_design_point(response, rng))
    return Estimate(
        probability=max(mean, 0.0),
        coefficient_of_variation=variation,
        interval=interval,
        failures=failures,
        errors=errors,
        simulations=response.simulations,
        method=method,
        design_point=design_point,
        remark=remark,
    )


def _failure_event(ot: Any, response: Callable[[Any], FloatArray], dimensions: int) -> Any:
    function = ot.PythonFunction(dimensions, 1, func_sample=lambda points: response(points)[:, np.newaxis])
    return ot.ThresholdEvent(ot.CompositeRandomVector(function, ot.RandomVector(ot.Normal(dimensions))), ot.Less(), 0.0)


@contextmanager
def _restore_generator() -> Iterator[None]:
    """Restore the state of OpenTURNS' random generator, which the whole process shares."""
    generator = load_openturns().RandomGenerator
    state = generator.GetState()
    try:
        yield
    finally:
        generator.SetState(state)


def _run_subset_simulation(response: Response, seed: int) -> tuple[float, float, list[float]]:
    """Probability, coefficient of variation and thresholds of a subset simulation."""
    ot, is_stagnant = load_openturns(), False
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
        return 0.0, 0.0, []
    thresholds = [float(value) for value in algorithm.getThresholdPerStep()]
    if is_stagnant:
        raise RareMethodError(PLATEAU)
    if thresholds[-1] > 0:
        return 0.0, 0.0, thresholds
    result = algorithm.getResult()
    return float(result.getProbabilityEstimate()), float(result.getCoefficientOfVariation()), thresholds


def _run_cross_entropy(response: Response, seed: int) -> tuple[float, float, list[float]]:
    """Probability and coefficient of variation by cross-entropy importance sampling with independent normal variables;
    no thresholds.
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
    return probability, float(result.getCoefficientOfVariation()) if probability > 0 else 0.0, []


def _remark_on_islands(response: Response, thresholds: list[float], rng: np.random.Generator) -> str:
    """A remark if failures lie on islands with safe settings between them: straight paths between islands do not stay
    near failure.
    """
    failures = response.failure_points
    if len(failures) < 2:
        return ""
    nodes = _select_distant_points(failures[rng.permutation(len(failures))[:2000]])
    first, second = np.triu_indices(len(nodes), 1)
    shares = np.linspace(0, 1, PATH_POINTS + 2)[1:-1]
    paths = nodes[first, np.newaxis] * (1 - shares[:, np.newaxis]) + nodes[second, np.newaxis] * shares[:, np.newaxis]
    response.stage = "paths between failures"
    peaks = response(paths.reshape(-1, response.dimensions)).reshape(len(first), PATH_POINTS).max(axis=1)
    levels = [value for value in thresholds if value > 0]
    limit = levels[len(levels) // 2] if levels else 0.0
    links = np.eye(len(nodes), dtype=bool)
    links[first, second] = links[second, first] = peaks <= limit
    island_count, _ = scipy.sparse.csgraph.connected_components(links)
    if island_count < 2:
        return ""
    return (
        f"failures lie on {island_count} islands with safe settings between them, and this method may have "
        "missed others; "
        "plain Monte Carlo misses none, with many samples"
    )


def _select_distant_points(points: FloatArray) -> FloatArray:
    """Points far from each other: each has the largest distance from all previously chosen points."""
    indices = [int(np.argmin(np.linalg.norm(points, axis=1)))]
    distance = np.linalg.norm(points - points[indices[0]], axis=1)
    while len(indices) < min(COMPARED_FAILURES, len(points)):
        indices.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[indices[-1]], axis=1))
    return points[indices]


def _find_design_point(response: Response, rng: np.random.Generator) -> FloatArray | None:
    """The failure nearest to the origin, searched between the nearest known failure and the origin, and around that
    failure.
    """
    if not len(response.failure_points):
        return None
    nearest, response.stage = _nearest_point(response.failure_points), "most probable failure"
    for search_round in range(SEARCH_ROUNDS):
        inner_points = nearest * np.linspace(0.5, 1.0, SEARCH_SETTINGS)[:, np.newaxis]
        random_points = (
            nearest * (1 - 0.05 * rng.random((SEARCH_SETTINGS, 1)))
            + rng.normal(size=(SEARCH_SETTINGS, response.dimensions)) * 0.4 / 2**search_round
        )
        for points in (inner_points, random_points):
            is_unsafe: BoolArray = response(points) < 0
            nearest = _nearest_point(np.vstack([nearest, points[is_unsafe]]))
    return nearest


def _nearest_point(points: FloatArray) -> FloatArray:
    return np.asarray(points[np.argmin(np.linalg.norm(points, axis=1))])
