"""The space of the free parameters of studies that are fitted together, and the loss at each place in the space."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from itertools import pairwise

import numpy as np

from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.loss import MAX_LOSS, ReferenceLoss, original_loss, original_residuals
from safevar_sumo.reference.parameters import FittedParameter
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.search import Misfit, StudyGroup
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine, settings_per_batch
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import inputs_of
from safevar_sumo.workers.evaluation import Pool, pack_study
from safevar_sumo.workers.interrupts import wait_for_result
from safevar_sumo.workers.retrying import RetryingPool

SIGNIFICANT_DIGITS = 6
"""Significant digits of the values that are tried."""


class FitSpace:
    """The unit cube of the parameters' bounds: a place in it determines the parameters' values, hence the studies and their loss."""

    def __init__(self, parameters: Sequence[FittedParameter], fits: Sequence[StudyFit]) -> None:
        self._parameters, self._fits = parameters, fits
        self._lower, self._upper = np.array([(parameter.bounds.lower, parameter.bounds.upper) for parameter in parameters]).T
        self._log = np.array([parameter.bounds.log for parameter in parameters])
        self._start, self._width = self._scaled(self._lower), self._scaled(self._upper) - self._scaled(self._lower)

    def _scaled(self, values: FloatArray) -> FloatArray:
        return np.log(values, out=values.copy(), where=self._log)

    def values(self, places: FloatArray) -> FloatArray:
        """The parameters' values at places, both of shape (..., parameters), with `SIGNIFICANT_DIGITS`.

        A study file then holds what was tried, and a search tries the same values where linear algebra differs in its last digits.
        """
        scaled = self._start + np.asarray(places) * self._width
        values = np.clip(np.exp(scaled, out=scaled.copy(), where=self._log), self._lower, self._upper)
        return np.array([float(f"{value:.{SIGNIFICANT_DIGITS}g}") for value in values.flat]).reshape(values.shape)

    def studies_at(self, place: FloatArray) -> StudyGroup:
        """The studies with the parameters' values at a place."""
        values = self.values(place).tolist()
        return tuple(
            with_values(fit.study, {parameter.key: value for parameter, value in zip(self._parameters, values, strict=True)
                                    if k in parameter.study_indices})
            for k, fit in enumerate(self._fits))

    def place_of(self, studies: StudyGroup) -> FloatArray:
        """The place at which the parameters have the values of the studies."""
        values = np.array([value_of(studies[parameter.study_indices[0]], parameter.key) for parameter in self._parameters])
        return np.asarray(np.clip((self._scaled(values) - self._start) / self._width, 0, 1))

    def misfits(self, groups: Sequence[StudyGroup]) -> list[Misfit]:
        """The mean loss of the studies of each group, and the residuals of all of them."""
        futures_of_groups = [[fit.submit(study) for fit, study in zip(self._fits, group, strict=True)] for group in groups]
        misfits_of_groups = ([fit.misfit(futures) for fit, futures in zip(self._fits, futures_of_studies, strict=True)]
                             for futures_of_studies in futures_of_groups)
        return [Misfit(float(np.mean([misfit.loss for misfit in misfits])), np.concatenate([misfit.residuals for misfit in misfits]))
                for misfits in misfits_of_groups]


class StudyFit:
    """A study with the data that it is fitted to, and the pool that simulates it."""

    def __init__(self, study: Study, references: Mapping[str, ReferenceData], pool: Pool) -> None:
        self.study = study
        self._losses = [ReferenceLoss(data, study) for data in references.values()]
        self._limits = [0, *np.cumsum([1, *(len(data.settings) for data in references.values())])]
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._inputs, self._pool = inputs_of(study, pool), RetryingPool(pool, study)
        settings = [self._characteristics.original[np.newaxis], *(data.settings for data in references.values())]
        self._settings, self._row_of = np.unique(np.concatenate(settings), axis=0, return_inverse=True)
        batches = max(1, round(len(self._settings) / settings_per_batch(assemble(study), Engine.RECORDED)))  # larger batches cost less
        self._batch_size = math.ceil(len(self._settings) / batches)

    def submit(self, study: Study) -> list[Future[Evaluations]]:
        """Begin to simulate the study, which may have other parameter values; returns a future for each batch of settings."""
        work, size = pack_study(study, self._inputs), self._batch_size
        return [self._pool.submit(work, self._settings[start:start + size]) for start in range(0, len(self._settings), size)]

    def misfit(self, futures: Sequence[Future[Evaluations]]) -> Misfit:
        """The loss and the residuals, from the futures of all batches."""
        distinct_evaluations = Evaluations.concatenate([wait_for_result(future) for future in futures])
        evaluations = distinct_evaluations.take(self._row_of.ravel())
        original, *files = [evaluations.take(np.arange(start, end)) for start, end in pairwise(self._limits)]
        published, fit = self.study.published, self.study.fit
        residuals = np.concatenate([original_residuals(original, published, fit),
                                    *(loss.residuals(file) for loss, file in zip(self._losses, files, strict=True))])
        if not evaluations.valid.all():
            return Misfit(MAX_LOSS, residuals)
        reference_losses = [loss.of(file) for loss, file in zip(self._losses, files, strict=True)]
        return Misfit(original_loss(original, published, fit) + sum(reference_losses) / max(len(files), 1), residuals)
