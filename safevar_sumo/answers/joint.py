"""All characteristics together: how large a box around the original is safe, and how sure that is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.boundary import Line, first_unsafe
from safevar_sumo.answers.unsafe import Unsafe, sobol_points
from safevar_sumo.records import FloatArray

CONFIDENCE = 0.95
PROBE, SAMPLES = 256, 1024
"""Settings within a box that are tried while it shrinks, and within the one that is left."""
FOLLOWED = 16
"""Unsafe settings, the nearest, that are followed back towards the original."""
STEP_BACK = 0.999
"""By what the box ends before the nearest unsafe setting that is known."""


class Joint(NamedTuple):
    """Within `factor` times the domain around the original, none of `samples` evenly spread settings is unsafe.

    So, with the stated confidence, at most `unsafe_at_most` of all settings in there are (Clopper and Pearson's bound).
    """

    factor: float
    confidence: float
    samples: int

    @property
    def unsafe_at_most(self) -> float:
        return float(scipy.stats.binomtest(0, self.samples, alternative="less").proportion_ci(self.confidence, method="exact").high)


def joint(bench: Bench, unsafe: Unsafe, known: FloatArray) -> Joint:
    """The largest safe box around an original vehicle that is safe itself.

    Parameters
    ----------
    known
        Unsafe settings that are known already, shape (K, n); the box ends before all of them.

    Notes
    -----
    A box is tried with Sobol points and, because it is there that all changes add up, with corners of the same number.
    The unsafe ones are followed back towards the original, the box ends before them, and so on until none is found.
    """
    factor = min(1.0, STEP_BACK * float(np.min(_reach(bench, known), initial=np.inf)))
    attempt, number = 0, PROBE
    while True:
        found = _unsafe_within(bench, factor, number, bench.study.search.seed + attempt, unsafe)
        attempt += 1
        if len(found):
            factor = min(factor, float(np.min(_reach(bench, _followed(bench, found, unsafe))))) * STEP_BACK
        elif number == SAMPLES:
            return Joint(factor, CONFIDENCE, SAMPLES)
        else:
            number = SAMPLES


def _unsafe_within(bench: Bench, factor: float, number: int, seed: int, unsafe: Unsafe) -> FloatArray:
    """Unsafe settings among Sobol points and corners of a box around the original, shape (K, n)."""
    members = bench.characteristics
    points = sobol_points(number, len(members), seed)
    lower = members.original - factor * (members.original - members.lower)
    upper = members.original + factor * (members.upper - members.original)
    settings = lower + np.concatenate([points, np.round(points)]) * (upper - lower)
    return settings[unsafe.of(bench.evaluate(settings, f"all characteristics within {factor:.0%} of the domain"))]


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
