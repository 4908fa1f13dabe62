"""Several characteristics together: how large a box around the original is safe, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from safevar_sumo.analysis.criterion import Unsafe, sobol_points
from safevar_sumo.analysis.evaluator import Bench
from safevar_sumo.analysis.explain.causes import Line, first_unsafe
from safevar_sumo.records import FloatArray

CONFIDENCE = 0.95
UNSAFE_AT_MOST = 0.003
"""Share of a box that may be unsafe, with that confidence, if every sampled setting is safe."""
PROBE, SEARCHED = 256, 1024
"""Sobol points, and as many corners, that look for unsafe settings: in every box that is tried, and in one in which the first find none."""
FOLLOWED = 16
"""Unsafe settings, the nearest, that are followed back towards the original."""
STEP_BACK = 0.999
"""By what the box ends before the nearest unsafe setting that is known."""
SMALLEST = 1e-6
"""A box that would have to be smaller is none."""


class SafeBox(NamedTuple):
    """Within `factor` times the domain around the original, no setting of a random sample is unsafe.

    With `confidence`, at most `unsafe_at_most` of all settings in the box are unsafe or cannot be simulated: `failed` of the `samples`
    settings could not be, and count as unsafe in that bound. `attempts` boxes were tested. Only `characteristics` vary, the others
    are the original's. Where no box is safe, `factor` is 0 and the bound 1.
    """

    factor: float
    confidence: float
    samples: int
    failed: int
    attempts: int
    unsafe_at_most: float
    characteristics: tuple[str, ...]

    def record(self) -> dict[str, Any]:
        """As `tolerance --json` prints it."""
        return {**self._asdict(), "characteristics": list(self.characteristics)}


def no_box(bench: Bench, columns: Sequence[int], attempts: int = 0) -> SafeBox:
    """What there is to say where the original vehicle itself is unsafe, or settings however near to it."""
    return SafeBox(0.0, CONFIDENCE, 0, 0, attempts, 1.0, tuple(bench.characteristics.names[column] for column in columns))


def safe_box(bench: Bench, columns: Sequence[int], unsafe: Unsafe, known: FloatArray) -> SafeBox:
    """The largest safe box around an original vehicle that is safe itself.

    Parameters
    ----------
    columns
        The characteristics that vary.
    known
        Unsafe settings that are known already, shape (K, n); the box ends before all of them.

    Notes
    -----
    A box is searched with Sobol points and, because it is there that all changes add up, with corners of the same number. The unsafe
    ones are followed back towards the original, the box ends before them, and so on until none is found. These points chose the box:
    they prove nothing about it.

    The box is then tested with settings drawn independently and uniformly in it, by a random generator of their own. If one is unsafe,
    the box shrinks and is searched and tested again. Test k, k = 1, 2, ..., may be wrong with probability alpha_k = alpha / 2^k, alpha
    = 1 - `confidence`: if test k accepts, the bound is Clopper and Pearson's upper one at confidence 1 - alpha_k for the share of the
    box that is unsafe or cannot be simulated. Box k depends on earlier samples alone, so given box k the bound fails with probability
    alpha_k at the most; all tests together fail with probability sum alpha_k <= alpha, whichever of them accepts. Later tests draw more
    settings, so that the bound stays `UNSAFE_AT_MOST` if all of them can be simulated.
    """
    factor = min(1.0, STEP_BACK * float(np.min(_reach(bench, known), initial=np.inf)))
    attempt = 0
    for search in range(10**6):
        if factor < SMALLEST:
            break
        for number in (PROBE, SEARCHED):
            points = _searched(number, len(columns), bench.study.search.seed + search)
            found, _ = _unsafe_within(bench, columns, factor, points, unsafe)
            if len(found):
                break
        else:
            attempt += 1
            error = (1 - CONFIDENCE) / 2**attempt
            samples = math.ceil(math.log(error) / math.log1p(-UNSAFE_AT_MOST))
            points = np.random.default_rng((bench.study.search.seed, attempt)).random((samples, len(columns)))
            found, failed = _unsafe_within(bench, columns, factor, points, unsafe)
            if not len(found):
                return SafeBox(factor, CONFIDENCE, samples, failed, attempt, share_at_most(failed, samples, 1 - error),
                               tuple(bench.characteristics.names[column] for column in columns))
        factor = min(factor, float(np.min(_reach(bench, _followed(bench, found, unsafe))))) * STEP_BACK
    return no_box(bench, columns, attempt)


def share_at_most(count: int, number: int, confidence: float) -> float:
    """Clopper and Pearson's exact upper bound of a share."""
    return float(scipy.stats.beta.ppf(confidence, count + 1, number - count)) if count < number else 1.0


def _searched(number: int, dimensions: int, seed: int) -> FloatArray:
    """Sobol points and corners of the unit cube, shape (2 number, dimensions)."""
    points = sobol_points(number, dimensions, seed)
    return np.concatenate([points, np.round(points)])


def _unsafe_within(bench: Bench, columns: Sequence[int], factor: float, points: FloatArray, unsafe: Unsafe) -> tuple[FloatArray, int]:
    """Unsafe settings, shape (K, n), at points of the unit cube that stands for a box around the original; and how many failed."""
    members, which = bench.characteristics, list(columns)
    lower = members.original - factor * (members.original - members.lower)
    upper = members.original + factor * (members.upper - members.original)
    settings = np.tile(members.original, (len(points), 1))
    settings[:, which] = lower[which] + points * (upper - lower)[which]
    evaluations = bench.evaluate(settings, f"all characteristics within {factor:.0%} of the domain")
    return settings[unsafe.of(evaluations)], int(np.count_nonzero(~evaluations.valid))


def _followed(bench: Bench, settings: FloatArray, unsafe: Unsafe) -> FloatArray:
    """The nearest of some unsafe settings, taken back towards the original as far as they stay unsafe."""
    near = settings[np.argsort(_reach(bench, settings), kind="stable")[:FOLLOWED]]
    lines = [Line(bench.characteristics.original, end, 0.0) for end in near]
    shares = first_unsafe(bench, lines, unsafe, "nearest unsafe settings")
    return np.stack([line.at(np.array([share]))[0] for line, share in zip(lines, shares, strict=True)])


def _reach(bench: Bench, settings: FloatArray) -> FloatArray:
    """By which factor a box must be smaller than the domain to have a setting on its surface, shape (K,)."""
    members = bench.characteristics
    change = settings - members.original
    room = np.where(change < 0, members.original - members.lower, members.upper - members.original)
    return np.asarray(np.max(np.divide(np.abs(change), room, out=np.zeros_like(change), where=room > 0), axis=1, initial=0.0))
