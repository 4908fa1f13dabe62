"""Make a page about the findings of studies. The package is callable:
`safevar_sumo.report(...)`.
"""

from __future__ import annotations

import sys
from types import ModuleType

from safevar_sumo.report.page import report as report


class _CallableModule(ModuleType):
    __call__ = staticmethod(report)


sys.modules[__name__].__class__ = _CallableModule
