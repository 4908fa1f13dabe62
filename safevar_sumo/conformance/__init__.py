"""Checks whether an author's own driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller works here."""

from safevar_sumo.conformance.finding import REFUSED, Finding, Report
from safevar_sumo.conformance.subject import KINDS, Subject, subject_of, subjects_of
from safevar_sumo.conformance.suite import check, checked, refuse_defects

__all__ = ["KINDS", "REFUSED", "Finding", "Report", "Subject", "check", "checked", "refuse_defects", "subject_of", "subjects_of"]
