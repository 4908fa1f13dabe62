"""Checks of user code: a driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller."""

from safevar_sumo.conformance.finding import BLOCKING_CHECKS, Finding, Report
from safevar_sumo.conformance.subject import KINDS, Subject, find_subject, subjects_of
from safevar_sumo.conformance.suite import check, check_subject, refuse_defects

__all__ = [
    "BLOCKING_CHECKS", "KINDS", "Finding", "Report", "Subject", "check", "check_subject", "find_subject", "refuse_defects", "subjects_of"]
