"""The loss of a study: a number for its disagreement with published data.

The table [fit] (`FitTable`) weights the parts.
"""

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
"""Largest deviation of a value of the original vehicle, as a multiple of the tolerance.

An undefined value has this deviation too.
"""
ROW_NOISE = 0.25
"""Standard deviation of the noise of a row in `residuals`, as a share of the standard deviation of the reference's
metric."""


def original_misfit(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> tuple[float, FloatArray]:
    """Loss and residuals of the original vehicle's metrics, which deviate from the published values.

    The loss is a mean, weighted by metric, in halves of a tolerance beyond the tolerance. Deviations within the
    tolerance cost nothing (Vapnik 1995): the published values come from a single simulation of the original vehicle,
    and the many rows of similar vehicles are stronger evidence. The residuals are the deviations in tolerances; their
    squares are weighted by metric.
    """
    names = [name for name in published if name in METRICS]
    if not names or not fit.original:
        return 0.0, np.empty(0)
    deviations = np.array([original.metrics[name][0] / published[name] - 1 for name in names]) / fit.tolerance
    deviations = np.nan_to_num(np.clip(deviations, -MAX_DEVIATION, MAX_DEVIATION), nan=MAX_DEVIATION)
    weights = np.array([fit.weights.get(name, 0.0) for name in names])
    excess = 2 * np.maximum(np.abs(deviations) - 1, 0.0)
    return fit.original * float(np.mean(weights * excess)), np.asarray(deviations * np.sqrt(weights))


class ReferenceLoss:
    """The loss of a study in comparison with one reference, the sum of:

    - 1 minus the rank correlation, and the mean absolute error, both weighted by metric;
    - differences between the effects of characteristics;
    - the share of rows that collide only in the reference, or only here.

    The unit of errors is the standard deviation of repeats of one setting in the reference or, if the study does not
    give it, of all values in the reference.
    """

    def __init__(self, data: ReferenceData, study: Study) -> None:
        self._data, self._study = data, study
        defined_values = {name: data.metrics[name][~np.isnan(data.metrics[name])] for name in study.fit.weights}
        self._deviations = {
            name: float(np.std(values)) for name, values in defined_values.items() if values.size and np.ptp(values) > 0
        }
        self._regression = Regression.over(data.settings, CharacteristicSet.of(study.vehicle.characteristics))
        self._effects = self._regression.effects(data.metrics[SAFETY_DEGREE])

    def of(self, evaluations: Evaluations) -> float:
        """The loss, from evaluations of the settings of the reference."""
        fit, loss = self._study.fit, 0.0
        # no result of the original is read below
        result = measure_agreement(self._data, evaluations, self._study, original=evaluations)
        for name, deviation in self._deviations.items():
            unit = self._study.repeatability.get(name) or deviation
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
        differences = [np.empty(0)]
        for name, deviation in self._deviations.items():
            errors = np.nan_to_num((evaluations.metrics[name] - self._data.metrics[name]) / (ROW_NOISE * deviation))
            differences.append(
                np.sqrt(self._study.fit.weights[name]) * np.where(evaluations.valid, errors, MAX_DEVIATION)
            )
        return np.concatenate(differences)
