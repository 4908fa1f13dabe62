"""Samples of a trace, and sums over them that do not depend on how many vehicles there are."""

from __future__ import annotations

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray

ROUNDING = 1e-6
"""Two times that differ by less are the same [s]."""


def every(step: float, interval: float | None) -> int:
    """How many simulation steps lie between two samples that are `interval` seconds apart.

    Raises
    ------
    InputError
        If that is no whole number.
    """
    if interval is None:
        return 1
    steps = round(interval / step)
    if steps < 1 or abs(steps * step - interval) > ROUNDING:
        raise InputError("study", f"metrics.sampling_interval = {interval}", f"a whole multiple of the simulation's step, {step:g} s")
    return steps


def total(samples: FloatArray) -> FloatArray:
    """Sum over the first axis, one after the other: numpy's own sum would group by the shape of the array."""
    return np.asarray(np.add.accumulate(samples, axis=0)[-1]) if len(samples) else np.zeros(samples.shape[1:])
