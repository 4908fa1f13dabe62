"""Boxes around the original vehicle: settings in them, and the test of a box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator, proof_size, sobol_points
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles.region import REJECTIONS

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
MAX_CORNERS = 4096
"""Largest number of corners of a box that are simulated."""
MET_BY_CORNERS = 32_768
"""Number of encounters that the corners meet together, in a study that searches its scenario."""


def settings_in_box(
    evaluator: Evaluator, columns: Sequence[int], lower: FloatArray, upper: FloatArray, points: FloatArray
) -> FloatArray:
    """Settings whose `columns` lie between `lower` and `upper`, shape (n,), from points of the unit cube; shape
    (K, n).
    """
    settings = np.tile(evaluator.characteristics.original, (len(points), 1))
    settings[:, columns] = lower[columns] + points * (upper - lower)[columns]
    return settings


def sobol_and_corners(
    evaluator: Evaluator, columns: Sequence[int], ends: tuple[FloatArray, FloatArray], number: int, seed: int
) -> FloatArray:
    """Settings at Sobol points of a box, and at as many of its corners, where all changes of the vehicle add up."""
    sobol, is_vehicle = sobol_points(number, len(columns), seed), evaluator.characteristics.of_vehicle[columns]
    points = np.concatenate([sobol, np.where(is_vehicle, np.round(sobol), sobol)])  # a rounded point is a corner
    return settings_in_box(evaluator, columns, *ends, points)


def corners_of(
    evaluator: Evaluator, columns: Sequence[int], ends: tuple[FloatArray, FloatArray], attempt: int
) -> FloatArray:
    """Settings at all corners of a box; at `MAX_CORNERS` random ones if it has more.

    In a study that searches its scenario, each corner of the vehicle's characteristics meets equally many encounters,
    drawn anew in each attempt.
    """
    characteristics, (lower, upper) = evaluator.characteristics, ends
    worn = [column for column in columns if characteristics.of_vehicle[column]]
    size, seed = len(worn), evaluator.study.search.seed
    rng = np.random.default_rng(seed)
    numbers = np.arange(2**size) if 2**size <= MAX_CORNERS else rng.integers(2**size, size=MAX_CORNERS)
    settings = np.tile(characteristics.original, (len(numbers), 1))
    bits = numbers[:, np.newaxis] >> np.arange(size) & 1
    settings[:, worn] = np.where(bits, upper[worn], lower[worn])
    if len(worn) == len(columns):
        return settings
    settings = np.tile(settings, (MET_BY_CORNERS // len(settings), 1))
    places = np.random.default_rng((seed, 3, attempt)).random(settings.shape)
    return np.where(characteristics.of_vehicle, settings, lower + places * (upper - lower))


def random_settings(
    evaluator: Evaluator,
    columns: Sequence[int],
    lower: FloatArray,
    upper: FloatArray,
    number: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Feasible settings drawn uniformly in a box; fewer than `number` if few are feasible.

    Raises
    ------
    InputError
        If none of the drawn settings is feasible.
    """
    settings = evaluator.region.draw_feasible(
        lambda count: settings_in_box(evaluator, columns, lower, upper, rng.random((count, len(columns)))), number
    )
    if not len(settings):
        raise InputError(
            evaluator.study.source,
            f"fewer than 1 in {REJECTIONS} random settings satisfy the constraints, which leaves "
            f"no box to test: {evaluator.region}",
            "characteristics that the constraints do not tie to each other",
        )
    return settings


def sample_box(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    ends: tuple[FloatArray, FloatArray],
    attempt: int,
    seed: Sequence[int],
    stage: str,
) -> tuple[FloatArray, int, int, float]:
    """Test a box with random settings.

    Returns the unsafe settings, the number of all settings, the number of those that could not be simulated, and a
    bound: at most this share of all settings in the box is unsafe or cannot be simulated.

    Notes
    -----
    The settings are drawn independently and uniformly, by a random generator that no search uses. Test k, k = 1, 2,
    ..., may be wrong with probability alpha_k = alpha / 2^k, alpha = 1 - `CONFIDENCE`: its bound is Clopper and
    Pearson's at confidence 1 - alpha_k. Box k depends on earlier samples alone, so given box k the bound fails with
    probability at most alpha_k. So the probability that any bound is wrong, and with it the bound of the box that
    passes, is at most sum alpha_k <= alpha. Later tests draw more settings, so that the bound stays `MAX_UNSAFE_SHARE`
    if all of them are safe.
    """
    error_probability, count = proof_size(attempt, MAX_UNSAFE_SHARE)
    settings = random_settings(evaluator, columns, *ends, count, np.random.default_rng(seed))
    evaluations = evaluator.evaluate(settings, stage)
    unsafe_settings = settings[unsafe.of(evaluations)]
    failed = int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))
    number, at_most = len(settings) - int(np.count_nonzero(evaluations.infeasible)), 1.0
    if safe := number - len(unsafe_settings) - failed:
        at_most = float(scipy.stats.beta.ppf(1 - error_probability, number - safe + 1, safe))
    return unsafe_settings, number, failed, at_most
