"""The command `check`: does user code keep the promises that results rest on? Nothing below `sumo` and `search` imports
this package.
"""

from safevar_sumo.plugins.check.subject import KINDS, Subject, find_subject
from safevar_sumo.plugins.check.suite import CHECKS, Finding, Report, check, check_subject, refuse_defects

__all__ = [
    "CHECKS",
    "KINDS",
    "Finding",
    "Report",
    "Subject",
    "check",
    "check_subject",
    "find_subject",
    "refuse_defects",
]
