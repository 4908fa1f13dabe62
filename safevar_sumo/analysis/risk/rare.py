"""Probabilities of rare failures in standard normal space: subset simulation and cross-entropy importance sampling, by OpenTURNS.

Au and Beck, Estimation of small failure probabilities in high dimensions by subset simulation, Probabilistic Engineering Mechanics 16
(2001); Rubinstein and Kroese, The cross-entropy method (2004).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, Evaluations, FloatArray

RARE_BELOW = 1e-2
"""Probability above which plain Monte Carlo is as good."""
PILOT = 1000
"""Number of vehicles first drawn by plain Monte Carlo, whose outcomes decide the method."""
ENOUGH = 100
"""Plain Monte Carlo is kept if, at the pilot's rate, all requested vehicles would have at least this many failures."""
SHARE = 0.1
"""p0: share of a level's vehicles, those nearest to failing, from which the next level starts."""
LEVEL = 1000
"""N: number of vehicles of a level. A block has p0 N vehicles, so that no vehicle continues from one in its own block."""
REPEATS, REPEATS_OF_RARER = 4, 8
"""Number of independent repeats for probabilities down to `RARER`, and below it."""
RARER = 3e-4
INFLATION = 1.3
"""Factor on OpenTURNS' coefficient of variation, which takes the levels of a subset simulation for independent of each other: over 240
repeats of linear limit states of 1e-3 to 1e-6 in 5 to 12 dimensions the observed coefficients are 1.1 to 1.3 times as large."""
PRIOR = 3
"""Degrees of freedom of the interval in addition to the number of repeats, for the information in OpenTURNS' own estimates."""
SMALLEST = 1e-10
"""Probability at which a subset simulation gives up."""
WIDTH = 2.0
"""Width of the uniform proposals of its Markov chains."""
SAFE = 1e6
"""Response where the safety degree is undefined or the simulation failed: as far from failing as possible."""
EDGE = 1e-9
"""Smallest absolute value of a response, so that its sign always shows whether the vehicle is unsafe."""
TIED = 0.5
"""The response is a plateau if at least this share of the vehicles nearest to failing have the same one."""
SEGMENT = 9
"""Number of points evaluated between two failures."""
COMPARED = 14
"""Maximum number of failures that are compared pairwise."""
AROUND = 100
"""Number of settings around the design point in each round of its search."""
ROUNDS = 4
Model = Callable[[FloatArray], FloatArray]
"""From points in standard normal space to settings."""


class PlateauError(Exception):
    """The response does not show which vehicles are nearer to failing."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A probability, its coefficient of variation and interval, the most probable failure in standard normal space, and remarks."""

    probability: float
    variation: float
    interval: tuple[float, float]
    failures: int
    errors: int
    simulations: int
    design_point: FloatArray | None
    remark: str


class Response:
    """The response g(u), below 0 where a vehicle is unsafe; counts simulations and remembers failures."""

    def __init__(self, evaluator: Evaluator, settings_of: Model, unsafe: Unsafe) -> None:
        self._evaluator, self._settings_of, self._unsafe = evaluator, settings_of, unsafe
        self.dimensions = len(evaluator.characteristics)
        self.simulations = self.errors = self.failed = 0
        self.stage = "rare failures"
        self.expected = 1
        self._points: list[FloatArray] = []
        """Failures, shape (k, n) each."""

    @property
    def failures(self) -> FloatArray:
        """Distinct unsafe points, shape (k, n)."""
        return np.unique(np.concatenate([np.zeros((0, self.dimensions)), *self._points]), axis=0)

    def __call__(self, points: Any) -> FloatArray:
        """The response at points, shape (N, n)."""
        array = np.asarray(points, dtype=float).reshape(-1, self.dimensions)
        evaluations = self._evaluator.evaluate(self._settings_of(array), self.stage, self.simulations, max(self.expected, self.simulations))
        return self.take(array, evaluations)

    def take(self, points: FloatArray, evaluations: Evaluations) -> FloatArray:
        """The response of points with known evaluations, which are counted and remembered."""
        unsafe = self._unsafe.of(evaluations)
        margin = self._unsafe.margin(evaluations)
        margin = np.where(evaluations.valid & ~np.isnan(margin), margin, SAFE)
        self.simulations += len(points)
        self.errors += int(np.count_nonzero(~evaluations.valid))
        self.failed += int(np.count_nonzero(unsafe))
        self._points.append(points[unsafe])
        return np.where(unsafe, np.minimum(margin, -EDGE), np.maximum(margin, EDGE))


def openturns() -> Any:
    """OpenTURNS, without messages of its own.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import openturns
    except ImportError:
        legal = "pip install 'safevar_sumo[rare]'; or --method monte_carlo"
        raise InputError("--rare or --method", "OpenTURNS is not installed", legal) from None
    openturns.Log.Show(openturns.Log.NONE)
    return openturns


def is_plateau(values: FloatArray) -> bool:
    """Whether the share p0 of the values, those nearest to failing, is mostly one value."""
    nearest = np.sort(values[values > 0])[:max(int(SHARE * len(values)), 2)]
    if not len(nearest):
        return False
    return bool(np.count_nonzero(nearest == nearest[-1]) >= TIED * len(nearest) or nearest[-1] >= SAFE)


def estimate_rare(response: Response, method: str, confidence: float, seed: int) -> Estimate:
    """Estimate the probability that a response is below 0.

    Parameters
    ----------
    method
        "subset_simulation" or "cross_entropy".

    Raises
    ------
    PlateauError
        If the response does not show which vehicles are nearer to failing.
    """
    run = _subset if method == "subset_simulation" else _cross_entropy
    probabilities, variations, thresholds = [], [], list[float]()
    repeats, number = REPEATS, 0
    response.expected = response.simulations + 4 * REPEATS * LEVEL
    with _generator_restored():
        while number < repeats:
            response.stage = f"rare failures, repeat {number + 1} of {repeats}"
            probability, variation, thresholds = run(response, (seed + 7919 * number) % 2**31)
            probabilities.append(probability)
            variations.append(variation)
            number += 1
            if number == REPEATS and method == "subset_simulation" and np.mean(probabilities) < RARER:
                repeats = REPEATS_OF_RARER
                response.expected = response.simulations * repeats // REPEATS
    mean = float(np.mean(probabilities))
    if mean <= 0:
        return Estimate(probability=0.0, variation=math.nan, interval=(0.0, SMALLEST), failures=response.failed, errors=response.errors,
                        simulations=response.simulations, design_point=None,
                        remark="no failure was found: either there is none, or the response does not lead to it")
    spread = float(np.std(probabilities, ddof=1)) / mean / math.sqrt(repeats)
    variation = max(spread, INFLATION * math.sqrt(float(np.mean(np.square(variations))) / repeats))
    quantile = float(scipy.stats.t.ppf((1 + confidence) / 2, repeats + PRIOR))
    factor = math.exp(quantile * math.sqrt(math.log1p(variation**2)))
    rng = np.random.default_rng(seed)
    remark = _remark_on_islands(response, thresholds, rng)
    return Estimate(probability=mean, variation=variation, interval=(mean / factor, min(mean * factor, 1.0)), failures=response.failed,
                    errors=response.errors, design_point=_design_point(response, rng), remark=remark, simulations=response.simulations)


def _event(ot: Any, response: Callable[[Any], FloatArray], dimensions: int) -> Any:
    function = ot.PythonFunction(dimensions, 1, func_sample=lambda points: response(points)[:, np.newaxis])
    return ot.ThresholdEvent(ot.CompositeRandomVector(function, ot.RandomVector(ot.Normal(dimensions))), ot.Less(), 0.0)


@contextmanager
def _generator_restored() -> Iterator[None]:
    """Restores the state of OpenTURNS' random generator, of which there is one for the whole process."""
    generator = openturns().RandomGenerator
    state = generator.GetState()
    try:
        yield
    finally:
        generator.SetState(state)


def _subset(response: Response, seed: int) -> tuple[float, float, list[float]]:
    """Probability, coefficient of variation and thresholds of a subset simulation."""
    ot, stuck = openturns(), [False]
    algorithm = ot.SubsetSampling(_event(ot, response, response.dimensions), WIDTH, SHARE)
    algorithm.setBlockSize(round(SHARE * LEVEL))
    algorithm.setMaximumOuterSampling(round(1 / SHARE))
    algorithm.setMaximumCoefficientOfVariation(-1.0)
    algorithm.setMinimumProbability(SMALLEST)

    def is_stuck() -> bool:
        thresholds = list(algorithm.getThresholdPerStep())
        stuck[0] = len(thresholds) > 1 and thresholds[-1] > 0 and thresholds[-1] == thresholds[-2]
        return stuck[0]

    algorithm.setStopCallback(is_stuck)
    ot.RandomGenerator.SetSeed(seed)
    try:
        algorithm.run()
    except TypeError as error:  # its estimate of a level's variance, a difference, can fall below 0
        if "variance estimate" not in str(error):
            raise
        return _subset(response, seed + 1)
    thresholds = [float(value) for value in algorithm.getThresholdPerStep()]
    if stuck[0]:
        raise PlateauError
    if thresholds[-1] > 0:
        return 0.0, 0.0, thresholds
    result = algorithm.getResult()
    return float(result.getProbabilityEstimate()), float(result.getCoefficientOfVariation()), thresholds


def _cross_entropy(response: Response, seed: int) -> tuple[float, float, list[float]]:
    """As `_subset`, by cross-entropy importance sampling with one normal distribution of independent components."""
    ot = openturns()
    algorithm = ot.StandardSpaceCrossEntropyImportanceSampling(_event(ot, response, response.dimensions), 2 * SHARE)
    algorithm.setBlockSize(LEVEL)
    algorithm.setMaximumOuterSampling(1)
    algorithm.setMaximumCoefficientOfVariation(-1.0)
    ot.RandomGenerator.SetSeed(seed)
    algorithm.run()
    result = algorithm.getResult()
    probability = float(result.getProbabilityEstimate())
    return probability, float(result.getCoefficientOfVariation()) if probability > 0 else 0.0, []


def _remark_on_islands(response: Response, thresholds: list[float], rng: np.random.Generator) -> str:
    """Remark on islands of failures with safe settings between them; straight paths within an island stay near to failing."""
    failures = response.failures
    if len(failures) < 2:
        return ""
    chosen = _apart(failures[rng.permutation(len(failures))[:2000]])
    first, second = np.triu_indices(len(chosen), 1)
    shares = np.linspace(0, 1, SEGMENT + 2)[1:-1]
    between = chosen[first, np.newaxis] * (1 - shares[:, np.newaxis]) + chosen[second, np.newaxis] * shares[:, np.newaxis]
    response.stage = "paths between failures"
    highest = response(between.reshape(-1, response.dimensions)).reshape(len(first), SEGMENT).max(axis=1)
    above = [value for value in thresholds if value > 0]
    limit = above[len(above) // 2] if above else 0.0
    joined = np.eye(len(chosen), dtype=bool)
    joined[first, second] = joined[second, first] = highest <= limit
    number, _ = scipy.sparse.csgraph.connected_components(joined)
    if number < 2:
        return ""
    return (f"failures lie on {number} islands with safe settings between them, and this method may have missed others; "
            "--method monte_carlo misses none, with many samples")


def _apart(points: FloatArray) -> FloatArray:
    """Points far from each other: each is the farthest from all chosen before it."""
    chosen = [int(np.argmin(np.linalg.norm(points, axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(COMPARED, len(points)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _design_point(response: Response, rng: np.random.Generator) -> FloatArray | None:
    """The failure nearest to the origin: searched from the nearest known one, towards the origin and around it in ever smaller steps."""
    if not len(response.failures):
        return None
    best, response.stage = _nearest(response.failures), "most probable failure"
    for number in range(ROUNDS):
        towards = best * np.linspace(0.5, 1.0, AROUND)[:, np.newaxis]
        around = best * (1 - 0.05 * rng.random((AROUND, 1))) + rng.normal(size=(AROUND, response.dimensions)) * 0.4 / 2**number
        for points in (towards, around):
            unsafe: BoolArray = response(points) < 0
            best = _nearest(np.vstack([best, points[unsafe]]))
    return best


def _nearest(points: FloatArray) -> FloatArray:
    return np.asarray(points[np.argmin(np.linalg.norm(points, axis=1))])
