"""Boxes around the original vehicle: settings in them, the test of a box, and the largest safe box that is the same
share of every domain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import find_boundary_shares, settings_on_lines
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles.region import REJECTIONS

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS = 256, 1024
"""Number of Sobol points, and of corners, in the first search of a box, and in a second search if the first finds
nothing unsafe.
"""
MAX_LINES = 16
"""Maximum number of unsafe settings, the nearest first, from which the search goes back towards the original."""
STEP_BACK = 0.999
"""The box ends at this share of the way to the nearest unsafe setting."""
MIN_FACTOR = 1e-6
"""Smallest factor of a box; below it there is no safe box."""


class SafeBox(NamedTuple):
    """A box around the original that is the same share of every domain; no setting of a random sample in it is unsafe.

    Attributes
    ----------
    factor
        The box's share of the way from the original to either end of the domain; 0 if no box is safe, because the
        original or a setting arbitrarily near to it is unsafe.
    confidence, unsafe_at_most
        With this confidence, at most this share of all settings in the box is unsafe or cannot be simulated; 1 if no
        box is safe.
    samples, failed
        Number of settings in the sample, and of those that could not be simulated, which count as unsafe in the bound.
    attempts
        Number of boxes tested.
    characteristics
        The characteristics that vary; the others keep their original values.
    """

    factor: float = 0.0
    confidence: float = CONFIDENCE
    samples: int = 0
    failed: int = 0
    attempts: int = 0
    unsafe_at_most: float = 1.0
    characteristics: tuple[str, ...] = ()


def find_safe_box(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    unsafe_settings: FloatArray,
    unsafe_solutions: FloatArray,
) -> SafeBox:
    """The largest safe box, in which `columns` vary, around an original vehicle that is safe itself.

    The box ends before all of `unsafe_settings`, shape (K, n): scans found them, so that there is no need to look for
    nearer ones on the way. From `unsafe_solutions`, shape (L, n), of a search it shrinks as from those found here.

    Notes
    -----
    The search of a box simulates Sobol points and as many corners. From unsafe settings the search goes back towards
    the original, and the box shrinks to end before the first unsafe setting on the way, until the search finds nothing
    unsafe. These settings determined the box, so they prove nothing about it: the box is then tested (`sample_box`). If
    the test finds anything unsafe, the box shrinks and is searched and tested again.
    """
    original, factor = evaluator.characteristics.original, 1.0
    below, above = original - evaluator.characteristics.lower, evaluator.characteristics.upper - original

    def factors_of(settings: FloatArray) -> FloatArray:
        """Factors of the boxes on whose surfaces K settings lie, shape (K,)."""
        change = settings - original
        room = np.where(change < 0, below, above)
        shares = np.divide(np.abs(change), room, out=np.zeros_like(change), where=room > 0)
        return np.asarray(np.max(shares, axis=1, initial=0.0))

    def shrunk(settings: FloatArray) -> float:
        """The factor of a box that ends before anything unsafe on the way from the original to the nearest ones of
        these settings.
        """
        nearest = settings[np.argsort(factors_of(settings), kind="stable")[:MAX_LINES]]
        starts = np.tile(original, (len(nearest), 1))
        shares, _ = find_boundary_shares(evaluator, starts, nearest, unsafe, stage="nearest unsafe settings")
        first_unsafe = settings_on_lines(starts, nearest, shares[:, np.newaxis])[:, 0]
        return min(factor, float(np.min(factors_of(first_unsafe)))) * STEP_BACK

    if len(unsafe_settings):
        factor = STEP_BACK * float(np.min(factors_of(unsafe_settings)))
    if len(unsafe_solutions):
        factor = shrunk(unsafe_solutions)
    seed, search_count, attempt = evaluator.study.search.seed, 0, 0
    while factor >= MIN_FACTOR:
        ends, stage = (original - factor * below, original + factor * above), f"all within {factor:.0%} of the domain"
        for point_count in (FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS):
            settings = sobol_and_corners(evaluator, columns, ends, point_count, seed + search_count)
            unsafe_inside = settings[unsafe.of(evaluator.evaluate(settings, stage))]
            if len(unsafe_inside):
                break
        else:  # no search found anything
            attempt += 1
            unsafe_inside, samples, failed, at_most = sample_box(
                evaluator, columns, unsafe, ends, attempt, (seed, attempt), stage
            )
            if not len(unsafe_inside):
                return SafeBox(factor, CONFIDENCE, samples, failed, attempt, at_most)
        factor, search_count = shrunk(unsafe_inside), search_count + 1
    return SafeBox(attempts=attempt)


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
    """Settings at Sobol points of a box, and at as many of its corners, where all changes add up."""
    sobol = sobol_points(number, len(columns), seed)
    points = np.concatenate([sobol, np.round(sobol)])  # a rounded point is a corner
    return settings_in_box(evaluator, columns, *ends, points)


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
    error_probability = (1 - CONFIDENCE) / 2**attempt
    count = math.ceil(math.log(error_probability) / math.log1p(-MAX_UNSAFE_SHARE))
    settings = random_settings(evaluator, columns, *ends, count, np.random.default_rng(seed))
    evaluations = evaluator.evaluate(settings, stage)
    unsafe_settings = settings[unsafe.of(evaluations)]
    failed = int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))
    number, at_most = len(settings), 1.0
    if safe := number - len(unsafe_settings) - failed:
        at_most = float(scipy.stats.beta.ppf(1 - error_probability, number - safe + 1, safe))
    return unsafe_settings, number, failed, at_most
