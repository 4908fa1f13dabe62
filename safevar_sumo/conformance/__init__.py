"""Checks of user code: a driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller."""

from safevar_sumo.conformance.finding import BLOCKING_CHECKS, Finding, Report
from safevar_sumo.conformance.subject import KINDS, Subject, subject_of, subjects_of
from safevar_sumo.conformance.suite import check, checked, refuse_defects

__all__ = ["BLOCKING_CHECKS", "KINDS", "Finding", "Report", "Subject", "check", "checked", "refuse_defects", "subject_of", "subjects_of"]
