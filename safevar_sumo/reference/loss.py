"""The loss of a study: a number for its disagreement with published data. The table [fit] (`FitTable`) weights the parts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.agreement import measure_agreement
from safevar_sumo.reference.effects import Regression
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE, FitTable, Study
from safevar_sumo.vehicles import CharacteristicSet

MAX_LOSS = 1e5
"""Largest loss of a study in one reference. A study that cannot be simulated has this loss too."""
MAX_DEVIATION = 10.0
"""Largest deviation of a value of the original vehicle, as a multiple of the tolerance. An undefined value has this deviation too."""
ROW_NOISE = 0.25
"""Standard deviation of the noise of a row in `residuals`, as a share of the standard deviation of the reference's metric."""


def original_loss(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> float:
    """How far the original vehicle's metrics deviate from the published values beyond the tolerance; a mean, weighted by metric.

    Deviations within the tolerance cost nothing (Vapnik 1995): the published values come from a single simulation of the original
    vehicle, and the many rows of similar vehicles are stronger evidence.
    """
    deviations = [fit.weights.get(name, 0.0) * _excess(original.metrics[name][0] / value - 1, fit.tolerance)
                  for name, value in published.items() if name in METRICS]
    return fit.original * float(np.mean(deviations)) if deviations else 0.0


def _excess(deviation: float, tolerance: float) -> float:
    """Excess of a relative deviation over the tolerance, in units of half a tolerance; 0 within the tolerance."""
    multiple = min(abs(deviation) / tolerance, MAX_DEVIATION) if np.isfinite(deviation) else MAX_DEVIATION
    return 2 * max(multiple - 1, 0.0)


def original_residuals(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> FloatArray:
    """Deviations of the original vehicle's metrics from the published values, in tolerances; their squares are weighted by metric."""
    if not fit.original:
        return np.empty(0)
    names = [name for name in published if name in METRICS]
    deviations = np.array([original.metrics[name][0] / published[name] - 1 for name in names]) / fit.tolerance
    deviations = np.nan_to_num(np.clip(deviations, -MAX_DEVIATION, MAX_DEVIATION), nan=MAX_DEVIATION)
    return np.asarray(deviations * np.sqrt([fit.weights.get(name, 0.0) for name in names]))


class ReferenceLoss:
    """The loss of a study in comparison with one reference, the sum of:

    - 1 minus the rank correlation, and the mean absolute error, both weighted by metric;
    - differences between the effects of characteristics;
    - the share of rows that collide only in the reference, or only here.

    The unit of errors is the standard deviation of repeats of one setting in the reference or, if the study does not give it, of all
    values in the reference.
    """

    def __init__(self, data: ReferenceData, study: Study) -> None:
        self._data, self._study = data, study
        self._units, self._noise = dict[str, float](), dict[str, float]()
        for name in study.fit.weights:
            values = data.metrics[name][~np.isnan(data.metrics[name])]
            if values.size and np.ptp(values) > 0:
                self._units[name] = study.repeatability.get(name) or float(np.std(values))
                self._noise[name] = ROW_NOISE * float(np.std(values))
        self._regression = Regression.over(data.settings, CharacteristicSet.of(study.vehicle.characteristics))
        self._effects = self._regression.effects(data.metrics[SAFETY_DEGREE])

    def of(self, evaluations: Evaluations) -> float:
        """The loss, from evaluations of the settings of the reference."""
        fit, loss = self._study.fit, 0.0
        result = measure_agreement(self._data, evaluations, self._study, original=evaluations)  # no result of the original is read below
        for name, unit in self._units.items():
            rho, error = result.spearman[name], result.mean_absolute_error[name]
            loss += fit.weights[name] * (fit.rank * (1 - (rho or 0.0)) + (np.inf if error is None else error) / unit)
            if name == SAFETY_DEGREE and fit.effects:
                differences = np.nan_to_num(self._regression.effects(evaluations.f_safe) - self._effects)
                loss += fit.effects * float(np.mean(np.abs(differences))) / unit
        collisions = result.collisions
        one_sided = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
        return min(loss, MAX_LOSS) + fit.collisions * one_sided / max(result.rows, 1)

    def residuals(self, evaluations: Evaluations) -> FloatArray:
        """Differences from the reference in standard deviations of their noise; their squares are weighted by metric.

        An undefined difference is 0; a row that cannot be simulated has differences of `MAX_DEVIATION`.
        """
        differences = [np.sqrt(self._study.fit.weights[name]) * np.where(
            evaluations.valid, np.nan_to_num((evaluations.metrics[name] - self._data.metrics[name]) / noise), MAX_DEVIATION)
            for name, noise in self._noise.items()]
        return np.concatenate([np.empty(0), *differences])
