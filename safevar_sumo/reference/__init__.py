"""Reference data: reading, comparison with a study, calibration, import as results."""

from safevar_sumo.analysis.parameters import with_values
from safevar_sumo.reference.calibration import FitSubject, calibrate, calibrate_together
from safevar_sumo.reference.effects import Coverage, Effect, covered_by_spread, effects_of
from safevar_sumo.reference.fit_result import Calibration
from safevar_sumo.reference.rows import ReferenceData, evaluations_of, original_metrics, package_filter, read_reference
from safevar_sumo.reference.validation import Agreement, Totals, agreement, keep_totals, plot_agreement, quoted

__all__ = [
    "Agreement",
    "Calibration",
    "Coverage",
    "Effect",
    "FitSubject",
    "ReferenceData",
    "Totals",
    "agreement",
    "calibrate",
    "calibrate_together",
    "covered_by_spread",
    "effects_of",
    "evaluations_of",
    "keep_totals",
    "original_metrics",
    "package_filter",
    "plot_agreement",
    "quoted",
    "read_reference",
    "with_values",
]
