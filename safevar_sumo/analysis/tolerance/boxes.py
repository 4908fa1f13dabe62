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
    """A box around the original, `factor` times as wide as the domain; no setting of a random sample in it is unsafe.

    With `confidence`, at most `unsafe_at_most` of all settings in the box are unsafe or cannot be simulated: `failed`
    of the `samples` settings could not be simulated, and count as unsafe in that bound. `attempts` boxes were tested.
    Only `characteristics` vary; the others keep their original values. If no box is safe, because the original or a
    setting arbitrarily near to it is unsafe, `factor` is 0 and the bound is 1.
    """

    factor: float = 0.0
    confidence: float = CONFIDENCE
    samples: int = 0
    failed: int = 0
    attempts: int = 0
    unsafe_at_most: float = 1.0
    characteristics: tuple[str, ...] = ()


def find_safe_box(
    evaluator: Evaluator, columns: Sequence[int], unsafe: Unsafe, unsafe_settings: FloatArray, known: FloatArray
) -> SafeBox:
    """The largest safe box, in which `columns` vary, around an original vehicle that is safe itself.

    The box ends before all of `unsafe_settings`, shape (K, n), each the nearest of its line. From the unsafe solutions
    of a search, `known`, shape (L, n), it shrinks as from unsafe settings that it finds itself.

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

    def shrunk(found: FloatArray) -> float:
        """The factor of a box that ends before all unsafe settings found on the straight ways from the original to some
        of these.
        """
        nearest = found[np.argsort(factors_of(found), kind="stable")[:MAX_LINES]]
        starts = np.tile(original, (len(nearest), 1))
        shares, _ = find_boundary_shares(evaluator, starts, nearest, unsafe, stage="nearest unsafe settings")
        edges = settings_on_lines(starts, nearest, shares[:, np.newaxis])[:, 0]
        return min(factor, float(np.min(factors_of(edges)))) * STEP_BACK

    if len(unsafe_settings):
        factor = min(factor, STEP_BACK * float(np.min(factors_of(unsafe_settings))))
    if len(known):
        factor = shrunk(known)
    seed, search, attempt = evaluator.study.search.seed, 0, 0
    while factor >= MIN_FACTOR:
        ends, stage = (original - factor * below, original + factor * above), f"all within {factor:.0%} of the domain"
        for point_count in (FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS):
            settings = sobol_and_corners(evaluator, columns, ends, point_count, seed + search)
            found = settings[unsafe.of(evaluator.evaluate(settings, stage))]
            if len(found):
                break
        else:
            attempt += 1
            found, samples, failed, at_most = sample_box(
                evaluator, columns, unsafe, ends, attempt, (seed, attempt), stage
            )
            if not len(found):
                return SafeBox(factor, CONFIDENCE, samples, failed, attempt, at_most)
        factor, search = shrunk(found), search + 1
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
    return settings_in_box(evaluator, columns, *ends, np.concatenate([sobol, np.round(sobol)]))


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


def sample_box(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    ends: tuple[FloatArray, FloatArray],
    attempt: int,
    seed: Sequence[int],
    stage: str,
) -> tuple[FloatArray, int, int, float]:
    """The unsafe ones of random settings in a box, the numbers of all and of those that could not be simulated, and the
    bound: at most this share of all settings in the box is unsafe or cannot be simulated.

    Notes
    -----
    The settings are drawn independently and uniformly, by a random generator that no search uses. Test k, k = 1, 2,
    ..., may be wrong with probability alpha_k = alpha / 2^k, alpha = 1 - `CONFIDENCE`: its bound is Clopper and
    Pearson's at confidence 1 - alpha_k. Box k depends on earlier samples alone, so given box k the bound fails with
    probability at most alpha_k; all tests together fail with probability sum alpha_k <= alpha, whichever of them
    accepts. Later tests draw more settings, so that the bound stays `MAX_UNSAFE_SHARE` if all of them are safe.
    """
    error_probability = (1 - CONFIDENCE) / 2**attempt
    number = math.ceil(math.log(error_probability) / math.log1p(-MAX_UNSAFE_SHARE))
    settings = random_settings(evaluator, columns, *ends, number, np.random.default_rng(seed))
    evaluations = evaluator.evaluate(settings, stage)
    found = settings[unsafe.of(evaluations)]
    failed = int(np.count_nonzero(~evaluations.valid & ~evaluations.infeasible))
    bad, number = len(found) + failed, len(settings)
    at_most = float(scipy.stats.beta.ppf(1 - error_probability, bad + 1, number - bad)) if bad < number else 1.0
    return found, number, failed, at_most
