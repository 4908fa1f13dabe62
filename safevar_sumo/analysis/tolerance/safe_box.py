"""All characteristics together: the largest safe box around the original."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, sobol_points
from safevar_sumo.analysis.explain.causes import Line, find_first_unsafe_shares
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


def names_of(evaluator: Evaluator, columns: Sequence[int]) -> tuple[str, ...]:
    return tuple(evaluator.characteristics.names[column] for column in columns)


def find_safe_box(
    evaluator: Evaluator,
    columns: Sequence[int],
    unsafe: Unsafe,
    unsafe_settings: FloatArray,
    solutions: pd.DataFrame | None = None,
) -> SafeBox:
    """The largest safe box around an original vehicle that is safe itself.

    Parameters
    ----------
    columns
        The characteristics that vary.
    unsafe_settings
        Unsafe settings, shape (K, n), each the nearest of its line; the box ends before all of them.
    solutions
        Unsafe solutions of a search; the box shrinks from them as from unsafe settings that it finds itself.

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
        lines = [Line(evaluator.characteristics.original, end, 0.0) for end in nearest]
        shares = find_first_unsafe_shares(evaluator, lines, unsafe, "nearest unsafe settings")
        edge_settings = [line.settings_at(np.array([share]))[0] for line, share in zip(lines, shares, strict=True)]
        return min(factor, float(np.min(_box_factors(evaluator, np.stack(edge_settings))))) * STEP_BACK

    factor = min(1.0, STEP_BACK * float(np.min(_box_factors(evaluator, unsafe_settings), initial=np.inf)))
    known = _solutions_of_columns(evaluator, columns, solutions)
    if len(known):
        factor = shrunk(factor, known)
    attempt = 0
    for search in range(10**6):
        if factor < MIN_FACTOR:
            break
        for point_count in (FIRST_SEARCH_POINTS, SECOND_SEARCH_POINTS):
            sobol = sobol_points(point_count, len(columns), evaluator.study.search.seed + search)
            points = np.concatenate([sobol, np.round(sobol)])  # and corners
            unsafe_found, _ = _unsafe_in_box(
                evaluator, factor, _settings_in_box(evaluator, columns, factor, points), unsafe
            )
            if len(unsafe_found):
                break
        else:
            attempt += 1
            error_probability = (1 - CONFIDENCE) / 2**attempt
            samples = math.ceil(math.log(error_probability) / math.log1p(-MAX_UNSAFE_SHARE))
            rng = np.random.default_rng((evaluator.study.search.seed, attempt))
            settings = _random_settings(evaluator, columns, factor, samples, rng)
            samples = len(settings)
            unsafe_found, failed = _unsafe_in_box(evaluator, factor, settings, unsafe)
            if not len(unsafe_found):
                bound = (
                    scipy.stats.beta.ppf(1 - error_probability, failed + 1, samples - failed)
                    if failed < samples
                    else 1.0
                )
                return SafeBox(factor, CONFIDENCE, samples, failed, attempt, float(bound), names_of(evaluator, columns))
        factor = shrunk(factor, unsafe_found)
    return SafeBox(attempts=attempt, characteristics=names_of(evaluator, columns))


def _solutions_of_columns(evaluator: Evaluator, columns: Sequence[int], solutions: pd.DataFrame | None) -> FloatArray:
    """The distinct solutions that change no other characteristics than these, shape (K, n)."""
    names, original = list(evaluator.characteristics.names), evaluator.characteristics.original
    if solutions is None:
        return np.zeros((0, len(names)))
    settings = np.unique(solutions[names].to_numpy(dtype=float), axis=0)
    others = np.setdiff1d(np.arange(len(names)), columns)
    return np.asarray(settings[(settings == original)[:, others].all(axis=1)])


def _settings_in_box(evaluator: Evaluator, columns: Sequence[int], factor: float, points: FloatArray) -> FloatArray:
    """Settings in a box around the original, from points of the unit cube; shape (K, n)."""
    characteristics, indices = evaluator.characteristics, list(columns)
    lower = characteristics.original - factor * (characteristics.original - characteristics.lower)
    upper = characteristics.original + factor * (characteristics.upper - characteristics.original)
    settings = np.tile(characteristics.original, (len(points), 1))
    settings[:, indices] = lower[indices] + points * (upper - lower)[indices]
    return settings


def _random_settings(
    evaluator: Evaluator, columns: Sequence[int], factor: float, number: int, rng: np.random.Generator
) -> FloatArray:
    """Feasible settings drawn uniformly in a box; fewer than `number` where few are feasible, an error where none
    is.
    """
    settings = evaluator.region.draw_feasible(
        lambda count: _settings_in_box(evaluator, columns, factor, rng.random((count, len(columns)))), number
    )
    if not len(settings):
        raise InputError(
            evaluator.study.source,
            f"fewer than 1 in {REJECTIONS} random settings satisfy the constraints, which leaves "
            f"no box to test: {evaluator.region}",
            "characteristics that the constraints do not tie to each other",
        )
    return settings


def refuse_tied(evaluator: Evaluator, columns: Sequence[int]) -> None:
    """Refuse characteristics that constraints tie so closely that hardly any setting in a box is feasible; raises
    `InputError`.
    """
    _random_settings(evaluator, columns, 1.0, 1, np.random.default_rng(evaluator.study.search.seed))


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
