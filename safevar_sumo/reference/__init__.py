"""Reference data: reading, comparison with a study, calibration, import as results."""

from safevar_sumo.reference.agreement import Totals, shipped_totals_of

__all__ = ["Totals", "shipped_totals_of"]
