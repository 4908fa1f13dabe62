"""What results mean: reference data and its comparison, without SUMO."""

from safevar_sumo.analysis.agreement import Agreement, agreement, plot_agreement
from safevar_sumo.analysis.reference import ReferenceData, package_filter, read_reference

__all__ = ["Agreement", "ReferenceData", "agreement", "package_filter", "plot_agreement", "read_reference"]
