"""The command `check`: does user code keep the promises that results rest on? Nothing below `sumo` and `search` imports
this package.
"""

from safevar_sumo.plugins.check.suite import (
    CHECKS as CHECKS,
    KINDS as KINDS,
    Finding as Finding,
    Report as Report,
    Subject as Subject,
    check as check,
    check_subject as check_subject,
    find_subject as find_subject,
    refuse_defects as refuse_defects,
)
