"""The loss of a study: its disagreement with published data (see `FitTable`)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.reference.effects import Regression
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.reference.validation import agreement
from safevar_sumo.study import SAFETY_DEGREE, FitTable, Study
from safevar_sumo.vehicles import CharacteristicSet

MAX_LOSS = 1e5
"""Largest loss of a reference; also the loss of a study that cannot be simulated."""
MAX_DEVIATION = 10.0
"""Largest deviation of the original vehicle's values [tolerances]; also that of an undefined value."""


def original_loss(original: Evaluations, published: Mapping[str, float], fit: FitTable) -> float:
    """Mean deviation of the original vehicle's values from the published ones beyond the tolerance, weighted by metric.

    Deviations within the tolerance cost nothing (Vapnik 1995): this is one vehicle, simulated once, and the rows of similar vehicles
    tell more about it.
    """
    deviations = [fit.weights.get(name, 0.0) * _beyond(original.metrics[name][0] / value - 1, fit.tolerance)
                  for name, value in published.items() if name in METRICS]
    return fit.original * float(np.mean(deviations)) if deviations else 0.0


def _beyond(deviation: float, tolerance: float) -> float:
    """How far a relative deviation lies beyond the tolerance [half tolerances]."""
    in_tolerances = min(abs(deviation) / tolerance, MAX_DEVIATION) if np.isfinite(deviation) else MAX_DEVIATION
    return 2 * max(in_tolerances - 1, 0.0)


class ReferenceLoss:
    """The loss of a study beside one reference: missing rank correlation and absolute errors, weighted by metric, differing effects, and
    differing collisions.

    Errors are in standard deviations of repeats of one setting in the reference, or, if unknown, of the reference's values.
    """

    def __init__(self, data: ReferenceData, study: Study) -> None:
        self._data, self._study, self._units = data, study, dict[str, float]()
        for name in study.fit.weights:
            values = data.metrics[name][~np.isnan(data.metrics[name])]
            if values.size and np.ptp(values) > 0:
                self._units[name] = study.repeatability.get(name) or float(np.std(values))
        self._regression = Regression.over(data.settings, CharacteristicSet.of(study.vehicle.characteristics))
        self._effects = self._regression.effects(data.metrics[SAFETY_DEGREE])

    def of(self, here: Evaluations) -> float:
        """The loss of evaluations of the reference's settings."""
        fit, loss, result = self._study.fit, 0.0, agreement(self._data, here, self._study, here)
        for name, unit in self._units.items():
            rho, error = result.spearman[name], result.mean_absolute_error[name]
            loss += fit.weights[name] * (fit.rank * (1 - (rho or 0.0)) + (np.inf if error is None else error) / unit)
            if name == SAFETY_DEGREE and fit.effects:
                differences = np.nan_to_num(self._regression.effects(here.f_safe) - self._effects)
                loss += fit.effects * float(np.mean(np.abs(differences))) / unit
        collisions = result.collisions
        differing = collisions["reference"] + collisions["here"] - 2 * collisions["both"]
        return min(loss, MAX_LOSS) + fit.collisions * differing / max(result.rows, 1)
