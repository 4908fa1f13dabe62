"""Reference data: reading, comparison with a study, calibration, import as results."""

from safevar_sumo.analysis.parameters import with_values
from safevar_sumo.reference.agreement import Agreement, Totals, measure_agreement, plot_agreement, shipped_totals_of, write_totals
from safevar_sumo.reference.calibration import FitSubject, calibrate, calibrate_together
from safevar_sumo.reference.effects import Coverage, Effect, effects_of, measure_coverage
from safevar_sumo.reference.fit_result import Calibration
from safevar_sumo.reference.rows import ReferenceData, evaluations_of, original_metrics, package_filter, read_reference

__all__ = [
    "Agreement",
    "Calibration",
    "Coverage",
    "Effect",
    "FitSubject",
    "ReferenceData",
    "Totals",
    "calibrate",
    "calibrate_together",
    "effects_of",
    "evaluations_of",
    "measure_agreement",
    "measure_coverage",
    "original_metrics",
    "package_filter",
    "plot_agreement",
    "read_reference",
    "shipped_totals_of",
    "with_values",
    "write_totals",
]
