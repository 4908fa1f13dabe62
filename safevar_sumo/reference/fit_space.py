"""The space of the free parameters of studies that are fitted together, and the loss at each place in the space.

A parameter belongs to one study, or several studies share it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.model_spread import value_of, with_values
from safevar_sumo.campaign.evaluation import Task
from safevar_sumo.campaign.identity import inputs_of
from safevar_sumo.campaign.pool import Batch, Pool, evaluate_batches
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.agreement import defined_pairs, rank_correlation
from safevar_sumo.reference.effects import linear_effects
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.search import Misfit
from safevar_sumo.study import SAFETY_DEGREE, FitTable, FreeParameter, Study
from safevar_sumo.sumo import Engine, settings_per_batch
from safevar_sumo.sumo.system import assemble, models_of
from safevar_sumo.vehicles import CharacteristicSet

SIGNIFICANT_DIGITS = 6
"""Significant digits of the values that are tried."""
MAX_LOSS = 1e5
"""Largest loss of a study in one reference. A study that cannot be simulated has this loss too."""
MAX_DEVIATION = 10.0
"""Largest deviation of a value of the original vehicle, as a multiple of the tolerance.

An undefined value has this deviation too.
"""
ROW_NOISE = 0.25
"""Standard deviation of the noise of a row in `residuals`, as a share of the standard deviation of the reference's
metric."""
StudyGroup = tuple[Study, ...]
"""Studies that are fitted together."""


class FittedParameter(NamedTuple):
    """A free parameter: its key, the indices of the studies that take its value, and its bounds."""

    key: str
    study_indices: tuple[int, ...]
    bounds: FreeParameter


def free_parameters(studies: Sequence[Study]) -> list[FittedParameter]:
    """The free parameters of studies that are fitted together.

    Studies that give a parameter the same value share the parameter, except studies whose table [calibration] marks it
    as `own`. A study with another value, or without the parameter, does not take part.

    Raises
    ------
    InputError
        If a parameter of a table [calibration] cannot be fitted, or its value lies outside its bounds.
    """
    parameters: list[FittedParameter] = []
    for index, study in enumerate(studies):
        for key, bounds in study.calibration.items():
            if any(key == parameter.key and index in parameter.study_indices for parameter in parameters):
                continue
            value = value_of(study, key)
            _check_bounds(study, key, value, bounds)
            sharing = (
                k for k, other in enumerate(studies) if k > index and not bounds.own and _shares(other, key, value)
            )
            parameters.append(FittedParameter(key, (index, *sharing), bounds))
    return parameters


def _shares(study: Study, key: str, value: float) -> bool:
    """Whether a study shares a parameter that has `value` in another study."""
    if key in study.calibration and study.calibration[key].own:
        return False
    try:
        return value_of(study, key) == value
    except InputError:
        return False


def _check_bounds(study: Study, key: str, value: float, bounds: FreeParameter) -> None:
    """Refuse bounds without the study's value, and bounds that the models do not accept: the search may try both."""
    if not bounds.lower <= value <= bounds.upper:
        raise InputError(
            study.source, f"{key} = {value}", f"a value in its bounds, [{bounds.lower:g}, {bounds.upper:g}]"
        )
    if bounds.log and bounds.lower <= 0:
        raise InputError(
            study.source, f"calibration.{key!r} has log = true and lower = {bounds.lower:g}", "a lower bound above 0"
        )
    for end, bound in (("lower", bounds.lower), ("upper", bounds.upper)):
        try:
            models_of(with_values(study, {key: bound}), key)
        except InputError as error:
            raise InputError(
                study.source, f"calibration.{key!r}.{end} = {bound:g}", error.legal or error.problem
            ) from None


class FitSpace:
    """The unit cube of the parameters' bounds.

    A place in it determines the parameters' values, and so the studies and their misfit.
    """

    def __init__(self, parameters: Sequence[FittedParameter], fits: Sequence[StudyFit]) -> None:
        self._parameters, self._fits = parameters, fits
        self._lower, self._upper = np.array(
            [(parameter.bounds.lower, parameter.bounds.upper) for parameter in parameters]
        ).T
        self._log = np.array([parameter.bounds.log for parameter in parameters])
        self._start, self._width = self._scaled(self._lower), self._scaled(self._upper) - self._scaled(self._lower)

    def _scaled(self, values: FloatArray) -> FloatArray:
        return np.log(values, out=values.copy(), where=self._log)

    def values(self, places: FloatArray) -> FloatArray:
        """The parameters' values at places, both of shape (..., parameters), with `SIGNIFICANT_DIGITS`.

        A study file then holds what was tried, and a search tries the same values where linear algebra differs in its
        last digits.
        """
        scaled = self._start + np.asarray(places) * self._width
        values = np.clip(np.exp(scaled, out=scaled.copy(), where=self._log), self._lower, self._upper)
        return np.array([float(f"{value:.{SIGNIFICANT_DIGITS}g}") for value in values.flat]).reshape(values.shape)

    def studies_at(self, place: FloatArray) -> StudyGroup:
        """The studies with the parameters' values at a place."""
        values = list(zip(self._parameters, self.values(place).tolist(), strict=True))
        return tuple(
            with_values(
                fit.study, {parameter.key: value for parameter, value in values if k in parameter.study_indices}
            )
            for k, fit in enumerate(self._fits)
        )

    def own_place(self) -> FloatArray:
        """The place at which the parameters have the values in the studies' files."""
        values = np.array(
            [value_of(self._fits[parameter.study_indices[0]].study, parameter.key) for parameter in self._parameters]
        )
        return np.asarray(np.clip((self._scaled(values) - self._start) / self._width, 0, 1))

    def misfits_at(self, places: Sequence[FloatArray]) -> list[Misfit]:
        """The mean loss of the studies at each place, and the residuals of all of them."""
        work = [
            (fit, fit.batches(study))
            for place in places
            for fit, study in zip(self._fits, self.studies_at(place), strict=True)
        ]
        evaluations = iter(evaluate_batches([batch for _, batches in work for batch in batches], self._fits[0].pool))
        misfits = [fit.misfit(list(islice(evaluations, len(batches)))) for fit, batches in work]
        groups = [misfits[start : start + len(self._fits)] for start in range(0, len(misfits), len(self._fits))]
        return [
            Misfit(float(np.mean([fit.loss for fit in group])), np.concatenate([fit.residuals for fit in group]))
            for group in groups
        ]


class StudyFit:
    """A study with the data that it is fitted to, and the pool that simulates it."""

    def __init__(self, study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> None:
        self.study = study
        self._references, self._inputs, self.pool = list(references.values()), inputs_of(study, pool), pool
        original = CharacteristicSet.of(study).original
        settings = [original[np.newaxis], *(data.settings for data in references.values())]
        self._ends = [0, *np.cumsum([len(rows) for rows in settings])]
        self._settings, self._row_of = np.unique(np.concatenate(settings), axis=0, return_inverse=True)
        # larger batches cost less
        batches = max(1, round(len(self._settings) / settings_per_batch(assemble(study), Engine.RECORDED)))
        self._batch_size = math.ceil(len(self._settings) / batches)

    def batches(self, study: Study) -> list[Batch]:
        """The batches that simulate the study, which may have other parameter values."""
        packed_task, size = Task(study=study, inputs=self._inputs).packed, self._batch_size
        return [
            Batch(packed_task, self._settings[start : start + size]) for start in range(0, len(self._settings), size)
        ]

    def misfit(self, batches: Sequence[Evaluations]) -> Misfit:
        """The loss and the residuals, from the evaluations of all batches."""
        evaluations = Evaluations.concatenate(batches).take(self._row_of.ravel())
        original, *files = [evaluations.take(np.arange(start, end)) for start, end in pairwise(self._ends)]
        of_original = original_misfit(original, self.study.published, self.study.fit)
        of_files = [
            reference_misfit(data, self.study, rows) for data, rows in zip(self._references, files, strict=True)
        ]
        loss = MAX_LOSS
        if evaluations.valid.all():
            loss = of_original.loss + sum(misfit.loss for misfit in of_files) / max(len(of_files), 1)
        return Misfit(loss, np.concatenate([misfit.residuals for misfit in (of_original, *of_files)]))


def original_misfit(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> Misfit:
    """Loss and residuals of the original vehicle's metrics in comparison with the published values.

    The loss is the mean, weighted by metric, of twice the deviations beyond the tolerance, in tolerances. Deviations
    within the tolerance cost nothing (Vapnik 1995): the published values come from a single simulation of the original
    vehicle, and the many rows of similar vehicles are stronger evidence. The residuals are the deviations in
    tolerances; their squares are weighted by metric.
    """
    names = [name for name in published if name in METRICS]
    if not names or not fit.original:
        return Misfit(0.0, np.empty(0))
    deviations = np.array([original.metrics[name][0] / published[name] - 1 for name in names]) / fit.tolerance
    deviations = np.nan_to_num(np.clip(deviations, -MAX_DEVIATION, MAX_DEVIATION), nan=MAX_DEVIATION)
    weights = np.array([fit.weights.get(name, 0.0) for name in names])
    excess = 2 * np.maximum(np.abs(deviations) - 1, 0.0)
    return Misfit(fit.original * float(np.mean(weights * excess)), np.asarray(deviations * np.sqrt(weights)))


def reference_misfit(data: ReferenceData, study: Study, evaluations: Evaluations) -> Misfit:
    """Loss and residuals of a study in comparison with one reference, from evaluations of the reference's settings.

    The loss is the sum of:

    - 1 minus the rank correlation, and the mean absolute error, both weighted by metric;
    - differences between the effects of characteristics;
    - the share of rows that collide only in the reference, or only here.

    The unit of errors is the standard deviation of repeats of one setting in the reference or, if the study does not
    give it, of all values in the reference.

    The residuals are differences in standard deviations of their noise; their squares are weighted by metric. An
    undefined difference is 0; a row that cannot be simulated has differences of `MAX_DEVIATION`.
    """
    fit, loss, residuals = study.fit, 0.0, [np.empty(0)]
    for name, weight in fit.weights.items():
        published, simulated = data.metrics[name], evaluations.metrics[name]
        defined = published[~np.isnan(published)]
        if not defined.size or np.ptp(defined) == 0:
            continue
        deviation = float(np.std(defined))
        unit, (there, here) = study.repeatability.get(name) or deviation, defined_pairs(published, simulated)
        error = float(np.mean(np.abs(here - there))) if here.size else np.inf
        loss += weight * (fit.rank * (1 - (rank_correlation(there, here) or 0.0)) + error / unit)
        if name == SAFETY_DEGREE and fit.effects:
            characteristics = CharacteristicSet.of(study)
            effects = [
                linear_effects(characteristics, data.settings, values) for values in (evaluations.f_safe, published)
            ]
            loss += fit.effects * float(np.mean(np.abs(np.nan_to_num(effects[0] - effects[1])))) / unit
        errors = np.nan_to_num((simulated - published) / (ROW_NOISE * deviation))
        residuals.append(np.sqrt(weight) * np.where(evaluations.valid, errors, MAX_DEVIATION))
    one_sided = np.count_nonzero(data.collided != evaluations.collided)
    loss = min(loss, MAX_LOSS) + fit.collisions * one_sided / max(len(evaluations), 1)
    return Misfit(loss, np.concatenate(residuals))
