"""SafeVar on SUMO: which smallest variations of a vehicle make its automated driving system unsafe?

`import safevar_sumo as sv`, and then `sv.simulate("rain", {"tireFric": 1.1})`. Every name below is loaded on first
use, so importing the package is fast.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safevar_sumo.analysis.evaluator import Progress
    from safevar_sumo.analysis.explain import explain
    from safevar_sumo.analysis.explain.result import Cause, Explained, Explanation
    from safevar_sumo.analysis.opinion import opinion
    from safevar_sumo.analysis.opinion.result import Opinion, Opinions
    from safevar_sumo.analysis.rating import rating
    from safevar_sumo.analysis.rating.compute import Rating
    from safevar_sumo.analysis.risk import risk
    from safevar_sumo.analysis.risk.compute import Risk
    from safevar_sumo.analysis.rules import rules
    from safevar_sumo.analysis.rules.compute import Rule, Rules
    from safevar_sumo.analysis.subject import Results, load
    from safevar_sumo.analysis.tolerance import tolerance
    from safevar_sumo.analysis.tolerance.compute import Tolerance
    from safevar_sumo.api.research_questions import Figures, Tables, figures, tables
    from safevar_sumo.api.running import run
    from safevar_sumo.api.simulation import Simulation, evaluate, simulate
    from safevar_sumo.campaign import Observer
    from safevar_sumo.errors import InputError, SafevarError, SimulationError
    from safevar_sumo.metrics import Criterion, Unsafe
    from safevar_sumo.records import Outcome
    from safevar_sumo.replay.animation import animate
    from safevar_sumo.replay.comparison import Comparison, compare
    from safevar_sumo.replay.figure import draw_comparison
    from safevar_sumo.replay.gui import show_in_gui
    from safevar_sumo.report import make_report
    from safevar_sumo.report import report as report
    from safevar_sumo.results import Status, status
    from safevar_sumo.study import Study, StudyLike, Weather, load_study, study_names
    from safevar_sumo.workers.evaluation import Pool

    __version__: str

_MODULES = {
    "metrics": ("Criterion", "Unsafe"),
    "study": ("load_study", "study_names", "Study", "StudyLike", "Weather"),
    "api": ("simulate", "Simulation", "evaluate", "run", "load", "Results", "tables", "Tables", "figures", "Figures"),
    "analysis.explain": ("explain",),
    "analysis.opinion": ("opinion",),
    "analysis.opinion.result": ("Opinion", "Opinions"),
    "analysis.tolerance": ("tolerance",),
    "analysis.risk": ("risk",),
    "analysis.rules": ("rules",),
    "analysis.rating": ("rating",),
    "analysis.rating.compute": ("Rating",),
    "analysis.evaluator": ("Progress",),
    "analysis.explain.result": ("Cause", "Explained", "Explanation"),
    "analysis.tolerance.compute": ("Tolerance",),
    "analysis.risk.compute": ("Risk",),
    "analysis.rules.compute": ("Rule", "Rules"),
    "campaign": ("Observer",),
    "workers.evaluation": ("Pool",),
    "records": ("Outcome",),
    "replay.comparison": ("Comparison", "compare"),
    "replay.figure": ("draw_comparison",),
    "replay.animation": ("animate",),
    "replay.gui": ("show_in_gui",),
    "report": ("make_report",),
    "results": ("status", "Status"),
    "errors": ("SafevarError", "InputError", "SimulationError"),
}
"""Modules, each with the public names that it provides."""
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Cause", "Comparison", "Criterion", "Explained", "Explanation", "Figures", "InputError", "Observer", "Opinion", "Opinions",
    "Outcome", "Pool", "Progress", "Rating", "Results", "Risk", "Rule", "Rules", "SafevarError", "Simulation", "SimulationError",
    "Status", "Study", "StudyLike", "Tables", "Tolerance", "Unsafe", "Weather", "__version__", "animate", "compare", "draw_comparison",
    "evaluate", "explain", "figures", "load", "load_study", "make_report", "opinion", "rating", "report", "risk", "rules", "run",
    "show_in_gui", "simulate", "status", "study_names", "tables", "tolerance",
]

if not TYPE_CHECKING:  # a type checker sees the names above and no others
    def __getattr__(name: str) -> Any:
        if sys.version_info < (3, 11):  # noqa: UP036 (older versions can parse this file and __main__)
            raise ImportError("safevar_sumo needs Python 3.11 or newer")
        if name == "__version__":
            from importlib.metadata import version

            return version("safevar_sumo")
        if name == "report":  # the package is callable: function and package share the name
            return importlib.import_module(f"{__name__}.report")
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)

    def __dir__() -> list[str]:
        return sorted(__all__)
