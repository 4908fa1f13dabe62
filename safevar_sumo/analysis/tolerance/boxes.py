"""Boxes around the original vehicle: settings in them, what of these is unsafe, and the largest safe box that is the
same share of every domain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import find_boundary_shares, settings_on_lines
from safevar_sumo.analysis.tolerance.answer import SafeBox
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


def find_safe_box(
    evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, unsafe_settings: FloatArray, known: FloatArray
) -> SafeBox:
    """The largest safe box, in which `columns` vary, around an original vehicle that is safe itself.

    The box ends before all of `unsafe_settings`, shape (K, n), each the nearest of its line. From the unsafe solutions
    of a search, `known`, shape (L, n), it shrinks as from unsafe settings that it finds itself.

    Notes
    -----
    The search of a box simulates Sobol points and as many corners, where all changes add up. From unsafe settings the
    search goes back towards the original, and the box shrinks to end before the first unsafe setting on the way, until
    the search finds nothing unsafe. These settings determined the box, so they prove nothing about it.

    The box is then tested with settings drawn independently and uniformly in it, by a separate random generator. If any
    is unsafe, the box shrinks and is searched and tested again. Test k, k = 1, 2, ..., may be wrong with probability
    alpha_k = alpha / 2^k, alpha = 1 - `confidence`: if test k accepts, the bound is Clopper and Pearson's upper bound
    at confidence 1 - alpha_k for the share of the box that is unsafe or cannot be simulated. Box k depends on earlier
    samples alone, so given box k the bound fails with probability at most alpha_k; all tests together fail with
    probability sum alpha_k <= alpha, whichever of them accepts. Later tests draw more settings, so that the bound stays
    `MAX_UNSAFE_SHARE` if all of them can be simulated.
    """

    def shrunk(factor: float, unsafe_found: FloatArray) -> float:
        """The factor of a box that ends before all unsafe settings found on the straight ways from the original to some
        of these.
        """
        nearest = unsafe_found[np.argsort(_box_factors(evaluator, unsafe_found), kind="stable")[:MAX_LINES]]
        starts = np.tile(evaluator.characteristics.original, (len(nearest), 1))
        shares, _ = find_boundary_shares(evaluator, starts, nearest, unsafe, stage="nearest unsafe settings")
        edges = settings_on_lines(starts, nearest, shares[:, np.newaxis])[:, 0]
        return min(factor, float(np.min(_box_factors(evaluator, edges)))) * STEP_BACK

    factor, seed = 1.0, evaluator.study.search.seed
    if len(unsafe_settings):
        factor = min(factor, STEP_BACK * float(np.min(_box_factors(evaluator, unsafe_settings))))
    if len(known):
        factor = shrunk(factor, known)
    search = attempt = 0
    while factor >= MIN_FACTOR:
        for point_count in (FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS):
            sobol = sobol_points(point_count, len(columns), seed + search)
            points = np.concatenate([sobol, np.round(sobol)])  # corners
            settings = settings_in_box(evaluator, columns, *_ends(evaluator, factor), points)
            unsafe_found, _ = _unsafe_in_box(evaluator, factor, settings, unsafe)
            if len(unsafe_found):
                break
        else:
            attempt += 1
            error_probability, samples = plan_test(attempt)
            rng = np.random.default_rng((seed, attempt))
            settings = random_settings(evaluator, columns, *_ends(evaluator, factor), samples, rng)
            unsafe_found, failed = _unsafe_in_box(evaluator, factor, settings, unsafe)
            if not len(unsafe_found):
                safe = len(settings) - failed
                bound = float(scipy.stats.beta.ppf(1 - error_probability, failed + 1, safe)) if safe else 1.0
                return SafeBox(factor, CONFIDENCE, len(settings), failed, attempt, bound)
        factor, search = shrunk(factor, unsafe_found), search + 1
    return SafeBox(attempts=attempt)


def _ends(evaluator: Evaluator, factor: float) -> tuple[FloatArray, FloatArray]:
    """The lower and upper ends, shape (n,), of the box that is `factor` times as wide as the domain."""
    characteristics = evaluator.characteristics
    return (
        characteristics.original - factor * (characteristics.original - characteristics.lower),
        characteristics.original + factor * (characteristics.upper - characteristics.original),
    )


def settings_in_box(
    evaluator: Evaluator, columns: Sequence[int], lower: FloatArray, upper: FloatArray, points: FloatArray
) -> FloatArray:
    """Settings whose `columns` lie between `lower` and `upper`, shape (n,), from points of the unit cube; shape
    (K, n).
    """
    indices = list(columns)
    settings = np.tile(evaluator.characteristics.original, (len(points), 1))
    settings[:, indices] = lower[indices] + points * (upper - lower)[indices]
    return settings


def random_settings(
    evaluator: Evaluator,
    columns: Sequence[int],
    lower: FloatArray,
    upper: FloatArray,
    number: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Feasible settings drawn uniformly in a box; fewer than `number` where few are feasible, an error where none
    is.
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


def plan_test(attempt: int) -> tuple[float, int]:
    """The error probability of test k of a box, k = 1, 2, ..., and the number of its settings."""
    error_probability = (1 - CONFIDENCE) / 2**attempt
    return error_probability, math.ceil(math.log(error_probability) / math.log1p(-MAX_UNSAFE_SHARE))


def _unsafe_in_box(evaluator: Evaluator, factor: float, settings: FloatArray, unsafe: Unsafe) -> tuple[FloatArray, int]:
    """The unsafe settings, shape (K, n), and the number of feasible settings that could not be simulated."""
    evaluations = evaluator.evaluate(settings, f"all characteristics within {factor:.0%} of the domain")
    return settings[unsafe.of(evaluations)], int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))


def _box_factors(evaluator: Evaluator, settings: FloatArray) -> FloatArray:
    """Factors of the boxes on whose surfaces K settings lie, shape (K,)."""
    characteristics = evaluator.characteristics
    change = settings - characteristics.original
    room = np.where(
        change < 0, characteristics.original - characteristics.lower, characteristics.upper - characteristics.original
    )
    return np.asarray(
        np.max(np.divide(np.abs(change), room, out=np.zeros_like(change), where=room > 0), axis=1, initial=0.0)
    )
