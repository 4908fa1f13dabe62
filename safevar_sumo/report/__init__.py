"""Make a page about the results of studies. The package itself is callable, so that
`safevar_sumo.report(...)` makes a page.
"""

from __future__ import annotations

import sys
from types import ModuleType

from safevar_sumo.report.page import report as report


class _CallableModule(ModuleType):
    __call__ = staticmethod(report)


sys.modules[__name__].__class__ = _CallableModule
