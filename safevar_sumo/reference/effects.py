"""The share of published rows within the model's uncertainty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.model_spread import band_of, evaluate_sets
from safevar_sumo.records import BoolArray
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE, Study

HOLD_OUT = 4
"""A fit leaves one of so many rows to judge on."""


class Coverage(NamedTuple):
    """Share of all published rows, and of those that a fit did not use, within the band of the model's predictions."""

    all_rows: float
    held_back: float | None


def measure_coverage(data: ReferenceData, study: Study) -> Coverage:
    """Measure how many published rows lie within the band of the model's uncertainty."""
    lower, upper = band_of(study, evaluate_sets(study, data.settings))
    published, held_back = data.metrics[SAFETY_DEGREE], is_held_back(data)
    is_within = (lower <= published) & (published <= upper)
    return Coverage(float(is_within.mean()), float(is_within[held_back].mean()) if held_back.any() else None)


def is_held_back(data: ReferenceData) -> BoolArray:
    """Whether a fit leaves a row to judge on; shape (rows,)."""
    return np.asarray(np.arange(len(data.settings)) % HOLD_OUT == HOLD_OUT - 1)
