"""Effects of characteristics on the safety degree, in a reference and here, and the share of published rows within the
model's uncertainty.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.model_spread import BAND_SHARE, band_of, error_distance, evaluate_sets
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet

RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 0.2, 0.1
"""Two effects agree if they differ by at most `RELATIVE_TOLERANCE` of the published effect, or by at most
`ABSOLUTE_TOLERANCE` metres."""
ROWS_PER_COEFFICIENT = 10
"""Minimum number of rows for each coefficient of a regression."""


class Effect(NamedTuple):
    """Change of the safety degree over the whole domain of a characteristic [m], in the reference and here; None if
    undefined.

    `agrees` is whether the two agree; None if one of them is undefined.
    """

    reference: float | None
    here: float | None
    agrees: bool | None


def linear_effects(characteristics: CharacteristicSet, settings: FloatArray, values: FloatArray) -> FloatArray:
    """How much `values`, shape (rows,), change over the whole domain of each characteristic, shape (n,), in their unit.

    By linear regression on all characteristics that the settings, shape (rows, n), vary; NaN where undefined.
    """
    defined, effects = np.isfinite(values), np.full(settings.shape[1], np.nan)
    shares = (settings[defined] - characteristics.original) / (characteristics.upper - characteristics.lower)
    varies = (shares != shares[:1]).any(axis=0)
    design = np.column_stack([np.ones(len(shares)), shares[:, varies]])
    if len(shares) >= ROWS_PER_COEFFICIENT * design.shape[1]:
        effects[varies] = np.linalg.pinv(design)[1:] @ values[defined]
    return effects


def effects_of(data: ReferenceData, evaluations: Evaluations, characteristics: CharacteristicSet) -> dict[str, Effect]:
    """The effect of each characteristic on the safety degree, in the order of the study."""
    sides = data.metrics[SAFETY_DEGREE], evaluations.f_safe
    published, here = (linear_effects(characteristics, data.settings, values) for values in sides)
    agrees = np.abs(here - published) <= np.maximum(ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE * np.abs(published))
    is_defined = np.isfinite(published + here)
    return {
        name: Effect(finite_or_none(published[i]), finite_or_none(here[i]), bool(agrees[i]) if is_defined[i] else None)
        for i, name in enumerate(characteristics.names)
    }


class Coverage(NamedTuple):
    """Share of the published rows that lie within the band of the model's predictions.

    `sets` and `rows` are numbers of parameter sets and rows; `all_rows` and `held_back` are shares of all rows, and of
    those that the fit did not use (None without such rows); `width` is the median width of the band [m]; `needed` is
    the margin on each side with which the band would cover 90 % of the rows held back, or of all rows [m].
    """

    sets: int
    rows: int
    all_rows: float
    held_back: float | None
    width: float
    needed: float

    def __str__(self) -> str:
        held_back = "none of them" if self.held_back is None else f"{self.held_back:.0%} of the rows"
        return (
            f"The {BAND_SHARE:.0%} band of {self.sets} parameter sets, of repeats and of the model's error is "
            f"{self.width:.2f} m wide (median) and covers {self.all_rows:.0%} of {self.rows} rows, {held_back} held "
            f"back; {self.needed:.2f} m more on each side would cover {BAND_SHARE:.0%} of "
            f"{'these rows' if self.held_back is None else 'the rows held back'}."
        )


def measure_coverage(data: ReferenceData, study: Study) -> Coverage:
    """Measure how many published rows lie within the band of the model's uncertainty.

    Raises
    ------
    InputError
        If the study has no spread.
    """
    evaluations = evaluate_sets(study, data.settings)
    lower, upper = band_of(study, evaluations)
    distances = _distance_from_band(data.metrics[SAFETY_DEGREE], lower, upper)
    held_back = is_held_back(data, study.fit.hold_out)
    new_rows = held_back if held_back.any() else ~held_back
    return Coverage(
        sets=len(evaluations),
        rows=len(distances),
        all_rows=float(np.mean(distances == 0)),
        held_back=float(np.mean(distances[held_back] == 0)) if held_back.any() else None,
        width=float(np.median(upper - lower)),
        needed=float(np.quantile(distances[new_rows], BAND_SHARE)),
    )


def is_held_back(data: ReferenceData, hold_out: int) -> BoolArray:
    """Whether a fit leaves a row to judge on: every `hold_out`-th row; shape (rows,)."""
    return np.asarray(np.arange(len(data.settings)) % hold_out == hold_out - 1)


def _distance_from_band(values: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Distance of values from a band; 0 inside the band."""
    return np.asarray(np.maximum(np.maximum(lower - values, values - upper), 0.0))


def error_beyond_spread(study: Study, references: Mapping[str, ReferenceData]) -> float:
    """The margin on each side with which the band would hold the share `BAND_SHARE` of new rows of each file.

    Its unit is m per domain width of distance from the original.

    The method is split conformal prediction (Lei et al. 2018), file by file; the largest margin counts. The score of a
    row is its distance from the band, divided by its `error_distance` from the original setting.
    """
    without_error, margins = msgspec.structs.replace(study, model_error={}), [0.0]
    for data in references.values():
        distances, published = error_distance(study, data.settings), data.metrics[SAFETY_DEGREE]
        is_usable = np.isfinite(published)
        if number := np.count_nonzero(is_usable):
            lower, upper = band_of(without_error, evaluate_sets(without_error, data.settings[is_usable]))
            scores = _distance_from_band(published[is_usable], lower, upper) / distances[is_usable]
            share = min(1.0, BAND_SHARE * (1 + 1 / number))  # + 1 for the new row
            margins.append(float(np.quantile(scores, share, method="inverted_cdf")))
    return max(margins)
