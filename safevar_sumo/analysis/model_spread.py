"""The vehicle model's own uncertainty: what its parameter sets that fit the published data as well make of one setting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from safevar_sumo.analysis.evaluator import finite_or_none
from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.matrix import evaluate, named_point
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet

BAND = 0.9
"""Share of the predictions that lie in a band."""
DEVIATIONS = 1.645
"""Standard deviations on each side of a normal distribution's mean that hold that share."""
AS_GIVEN = 1e-5
"""Relative difference below which a study has the value of its spread's first set, which is rounded."""


@dataclass(frozen=True, kw_only=True)
class ModelSpread:
    """What the parameter sets of a study's table [spread] make of one setting.

    Attributes
    ----------
    sets
        How many sets there are.
    lower, upper
        The band that 90 % of their safety degrees and of repeats of one simulation lie in, wider by the model's error where the study
        tells it [m, or -m/s]; None where none has one.
    collisions
        With how many of the sets the setting collides.
    """

    sets: int
    lower: float | None
    upper: float | None
    collisions: int

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    def __str__(self) -> str:
        """One sentence."""
        if self.lower is None or self.upper is None:
            return f"no safety degree with any of {self.sets} parameter sets that fit the published data as well"
        hits = "none of them" if not self.collisions else f"{self.collisions} of them"
        return (f"safety degree {self.lower:.2f} to {self.upper:.2f} ({BAND:.0%} band of {self.sets} parameter sets that fit the published "
                f"data as well, of repeats and of the model's error); a collision with {hits}")


def model_spreads(study: Study, settings: FloatArray, point: str = "") -> list[ModelSpread]:
    """The model's own uncertainty for each of some settings, shape (M, n), as they are, without the filter; in a matrix at one point of it,
    or where each comes off worst.

    Raises
    ------
    InputError
        If the study has no spread, or one of parameters that it does not have.
    """
    evaluations = evaluations_of_sets(study, settings, point)
    lower, upper = band_of(study, evaluations)
    hits = np.stack([one.collided for one in evaluations]).sum(axis=0)
    return [ModelSpread(sets=len(evaluations), lower=finite_or_none(low), upper=finite_or_none(high), collisions=int(hit))
            for low, high, hit in zip(lower.tolist(), upper.tolist(), hits.tolist(), strict=True)]


def band_of(study: Study, evaluations: Sequence[Evaluations]) -> tuple[FloatArray, FloatArray]:
    """Ends of the band of what the parameter sets make of settings, repeats and the model's error with it; each of shape (M,)."""
    error = study.model_error.get(SAFETY_DEGREE, 0.0) * distance(study, evaluations[0].settings)
    return band(np.stack([one.f_safe for one in evaluations]), study.repeatability.get(SAFETY_DEGREE, 0.0), error)


def distance(study: Study, settings: FloatArray) -> FloatArray:
    """How far settings are from the original vehicle, each characteristic in widths of its domain (Euclidean); shape (M,)."""
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    return np.asarray(np.linalg.norm((settings - characteristics.original) / (characteristics.upper - characteristics.lower), axis=1))


def band(safety_degrees: FloatArray, repeatability: float, error: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Ends of the band of predictions, shape (sets, M), and of repeats of one simulation, `error` wider on each side; of shape (M,)."""
    lower, upper = np.full(safety_degrees.shape[1], np.nan), np.full(safety_degrees.shape[1], np.nan)
    defined = np.isfinite(safety_degrees).any(axis=0)
    lower[defined], upper[defined] = np.nanquantile(safety_degrees[:, defined], [(1 - BAND) / 2, (1 + BAND) / 2], axis=0)
    return lower - DEVIATIONS * repeatability - error, upper + DEVIATIONS * repeatability + error


def evaluations_of_sets(study: Study, settings: FloatArray, point: str = "") -> list[Evaluations]:
    """Some settings, shape (M, n), with each of the parameter sets, the study's own first; in this process."""
    systems = [assemble(one) for one in studies_of_sets(study)]
    return [evaluate(named_point(one, point, "point") if point else one, settings) for one in systems]


def studies_of_sets(study: Study) -> list[Study]:
    """The study with each of the parameter sets. A parameter to which the study gives another value than the first set keeps it.

    Raises
    ------
    InputError
        If there are no sets, or a parameter of theirs is none of the study's.
    """
    if not study.spread:
        raise InputError(study.source, "has no table [spread]", "a study that `calibrate` has fitted, such as sun or rain")
    sets = {key: values for key, values in study.spread.items() if np.isclose(value_of(study, key), values[0], rtol=AS_GIVEN, atol=0)}
    count = len(next(iter(study.spread.values())))
    return [study, *(with_values(study, {key: values[k] for key, values in sets.items()}) for k in range(1, count))]
