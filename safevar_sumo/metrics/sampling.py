"""Samples of a trace, and sums over them that do not depend on how many vehicles there are."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import FloatArray


def every(step: float, interval: float | None) -> int:
    """How many simulation steps lie between two samples that are `interval` seconds apart."""
    return 1 if interval is None else max(1, round(interval / step))


def total(samples: FloatArray) -> FloatArray:
    """Sum over the first axis, one after the other: numpy's own sum would group by the shape of the array."""
    return np.asarray(np.add.accumulate(samples, axis=0)[-1])
