"""Signals that arrive late: a history of samples, read back by every vehicle at its own age."""

from __future__ import annotations

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray

LONGEST = 3600.0
"""[s]"""


def history(longest: float, step: float, sample: FloatArray) -> FloatArray:
    """Room for delays up to `longest` seconds, filled with a first sample of shape (..., N); newest first.

    Raises
    ------
    InputError
        If nobody simulates that long.
    """
    if not longest <= LONGEST:
        raise InputError("vehicle", f"one of its delays is {longest:g} s", f"up to {LONGEST:g} s")
    length = int(longest / step) + 2
    return np.repeat(sample[np.newaxis], length, axis=0)


def remembered(past: FloatArray, sample: FloatArray) -> FloatArray:
    """The history with a new sample in front and the oldest forgotten."""
    return np.concatenate([sample[np.newaxis], past[:-1]])


def delayed(past: FloatArray, delay: FloatArray, step: float) -> FloatArray:
    """What vehicle i's signal was `delay[i]` seconds ago, linear between two samples; shape (..., N)."""
    age = delay / step
    newer = np.floor(age)
    share = age - newer
    row, column = newer.astype(np.intp), np.arange(len(delay))
    after, before = np.moveaxis(past[row, ..., column], 0, -1), np.moveaxis(past[row + 1, ..., column], 0, -1)
    with np.errstate(invalid="ignore"):  # infinitely far a whole number of steps ago, and now in sight
        between = after * (1 - share) + before * share
    return np.where(np.isnan(between), after, between)
