"""Reference data: reading, comparison with a study, calibration, import as results."""

from safevar_sumo.reference.agreement import Totals as Totals, shipped_totals_of as shipped_totals_of
