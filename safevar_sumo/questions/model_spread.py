"""The uncertainty of the vehicle model: the spread of the predictions for a setting by all
parameter sets (calibrations) that fit the published data equally well.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from safevar_sumo.errors import InputError, about
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import Evaluations, FloatArray, NamedValues, finite_or_none
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import SAFETY_DEGREE, Study, convert_table, locate_parameter
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

BAND_SHARE = 0.9
"""Share of the predictions that lie in the band."""
HALF_WIDTH = 1.645
"""Half the width [standard deviations] of the interval that holds `BAND_SHARE` of a normal
distribution.
"""
ROUNDING_TOLERANCE = 1e-5
"""Relative tolerance within which a parameter's value in the study equals its (rounded) value in
the first set of [spread].
"""
LEAST_CHANGE_SIZE = 0.3
"""Least distance from the original vehicle to which the model's error is proportional [domain
widths]. Also near the original, a decision of the driving system may fall one step earlier or
later.
"""


class ModelSpread(NamedTuple):
    """The predictions for a setting by the parameter sets of a study's table [spread].

    Attributes
    ----------
    sets
        Number of parameter sets.
    lower, upper
        Ends of the band that holds 90 % of the sets' safety degrees and of repeats of a simulation
        [m, or -m/s]. The model's error widens the band if the study states this error. None if no
        set has a safety degree.
    collisions
        Number of parameter sets with which the vehicle collides.
    """

    sets: int
    lower: float | None
    upper: float | None
    collisions: int


def compute_model_spreads(
    study: Study, settings: FloatArray, point: str = ""
) -> list[ModelSpread]:
    """The model's uncertainty for each of M settings, shape (M, n); the filter is not applied.

    In a matrix, all settings are simulated at `point`; if no point is named, each setting at its
    worst point.

    Raises
    ------
    InputError
        If the study has no spread, or the spread names a parameter that the study lacks.
    """
    evaluations = evaluate_sets(study, settings, point)
    collisions = np.sum([prediction.collided for prediction in evaluations], axis=0)
    spreads = []
    ends = band_of(study, evaluations)
    for low, high, count in zip(*ends, collisions.tolist(), strict=True):
        band = finite_or_none(low), finite_or_none(high)
        spreads.append(ModelSpread(len(evaluations), *band, count))
    return spreads


def band_of(
    study: Study, evaluations: Sequence[Evaluations]
) -> tuple[FloatArray, FloatArray]:
    """The lower and upper ends, shape (M,) each, of the band that holds the predictions for M
    settings. `evaluations` has the evaluations of these settings with each parameter set.
    """
    error = study.model_error.get(SAFETY_DEGREE, 0.0) * error_distance(
        study, evaluations[0].settings
    )
    return prediction_band(
        np.stack([prediction.f_safe for prediction in evaluations]),
        study.repeatability.get(SAFETY_DEGREE, 0.0),
        error,
    )


def error_distance(study: Study, settings: FloatArray) -> FloatArray:
    """The distance of settings from the original vehicle to which the model's error is
    proportional, shape (M,).

    It is the Euclidean distance, each characteristic in widths of its domain, but at least
    `LEAST_CHANGE_SIZE`.
    """
    characteristics = CharacteristicSet.of(study)
    changes = (settings - characteristics.original) / (
        characteristics.upper - characteristics.lower
    )
    return np.asarray(np.maximum(np.linalg.norm(changes, axis=1), LEAST_CHANGE_SIZE))


def prediction_band(
    safety_degrees: FloatArray, repeatability: float, error: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Lower and upper ends, shape (M,) each, of the band of predicted safety degrees, shape (sets,
    M).

    Repeats of a simulation, with the standard deviation `repeatability`, and the model's `error`
    widen the band on each side.
    """
    ends = np.full((2, safety_degrees.shape[1]), np.nan)
    is_defined = np.isfinite(safety_degrees).any(axis=0)
    shares = [(1 - BAND_SHARE) / 2, (1 + BAND_SHARE) / 2]
    ends[:, is_defined] = np.nanquantile(safety_degrees[:, is_defined], shares, axis=0)
    lower, upper = ends
    return (
        lower - HALF_WIDTH * repeatability - error,
        upper + HALF_WIDTH * repeatability + error,
    )


def evaluate_sets(
    study: Study, settings: FloatArray, point: str = ""
) -> list[Evaluations]:
    """Evaluate settings, shape (M, n), in this process with each parameter set, first with the
    study's values.
    """
    if point:
        study = at_point(study, point)
    evaluations = []
    for k, fitted_study in enumerate(studies_of_sets(study)):
        called = f"{study.source}: spread: set {k}" if k else study.source
        system = assemble(
            replace(fitted_study, origin=replace(fitted_study.origin, called=called))
        )
        evaluations.append(drive_and_score(system, settings))
    return evaluations


def studies_of_sets(study: Study) -> list[Study]:
    """The study with each of its parameter sets, first the study itself. Parameters that are
    `parameters_outside_sets` keep the study's values.

    Raises
    ------
    InputError
        If the study has no parameter sets, or lacks a parameter that they name.
    """
    if not study.spread:
        raise InputError(
            study.source,
            "has no table [spread]",
            "a study that was fitted to data, such as sun or rain",
        )

    outside_names = parameters_outside_sets(study)
    names = [key for key in study.spread if key not in outside_names]
    studies = [study]
    for k in range(1, len(next(iter(study.spread.values())))):
        values = {key: study.spread[key][k] for key in names}
        studies.append(with_values(study, values))
    return studies


def other_sets(study: Study, fits: int | None) -> list[Study]:
    """The study with each of its first `fits` parameter sets, except its own (the first). None
    means all sets. There are no other sets if `fits` is 0, or the study has no [spread].
    """
    return studies_of_sets(study)[1:fits] if study.spread and fits != 0 else []


def parameters_outside_sets(study: Study) -> list[str]:
    """The parameters under [spread] whose value in `study` is not the value in the first set. The
    sets were not fitted for such a value, so they say nothing about it.
    """
    return [
        key
        for key, values in study.spread.items()
        if not np.isclose(
            value_of(study, key), values[0], rtol=ROUNDING_TOLERANCE, atol=0
        )
    ]


def with_values(study: Study, values: NamedValues) -> Study:
    """A study with other values of some parameters, which are named by their keys in the study
    file.

    Raises
    ------
    InputError
        If the study lacks a parameter, or a value is not allowed for its parameter.
    """
    tables = _as_tables(study)
    for name, value in values.items():
        table, key = locate_parameter(tables, name)
        table[key] = value
    with about(study.source):
        return convert_table(tables, Study)


def value_of(study: Study, name: str) -> float:
    """The value of a parameter in the study."""
    table, key = locate_parameter(_as_tables(study), name)
    return float(table[key])


def _as_tables(study: Study) -> Any:
    """The study as plain tables; a weather's name is replaced by the weather's table."""
    return msgspec.to_builtins(replace(study, weather=weather_of(study.weather)))
