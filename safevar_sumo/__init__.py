"""SafeVar on SUMO: which smallest variations of a vehicle make its automated driving system unsafe?

`import safevar_sumo as sv`, and then `sv.simulate("rain", {"tireFric": 1.1})`. Every name below is loaded when it is used
first, so importing the package costs next to nothing.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safevar_sumo.api.questions import Figures, Tables, explain, figures, risk, rules, tables, tolerance
    from safevar_sumo.api.results import Results, load
    from safevar_sumo.api.running import run
    from safevar_sumo.api.settings import evaluate
    from safevar_sumo.api.simulation import Simulation, simulate
    from safevar_sumo.errors import InputError, SafevarError, SimulationError
    from safevar_sumo.replay.animation import animate
    from safevar_sumo.replay.comparison import Comparison, compare
    from safevar_sumo.replay.figure import draw_comparison
    from safevar_sumo.replay.gui import show_in_gui
    from safevar_sumo.report import make_report
    from safevar_sumo.results import Status, status
    from safevar_sumo.study import Study, Weather, load_study, study_names

    __version__: str

_ROOM_OF = {
    "load_study": "study", "study_names": "study", "Study": "study", "Weather": "study",
    "simulate": "api", "Simulation": "api",
    "evaluate": "api",
    "run": "api", "load": "api", "Results": "api",
    "tables": "api", "Tables": "api",
    "figures": "api", "Figures": "api",
    "explain": "api", "tolerance": "api", "risk": "api", "rules": "api",
    "Comparison": "replay", "compare": "replay", "draw_comparison": "replay", "animate": "replay", "show_in_gui": "replay",
    "make_report": "report",
    "status": "results", "Status": "results",
    "SafevarError": "errors", "InputError": "errors", "SimulationError": "errors",
}
"""Every public name and the room that it comes from."""

__all__ = [
    "Comparison", "Figures", "InputError", "Results", "SafevarError", "Simulation", "SimulationError", "Status", "Study", "Tables",
    "Weather", "__version__", "animate", "compare", "draw_comparison", "evaluate", "explain", "figures", "load", "load_study",
    "make_report", "risk", "rules", "run", "show_in_gui", "simulate", "status", "study_names", "tables", "tolerance",
]

if not TYPE_CHECKING:  # a type checker is to know the names above, and no others
    def __getattr__(name: str) -> Any:
        if sys.version_info < (3, 11):  # noqa: UP036 (this file and __main__ alone can be read by older versions)
            raise ImportError("safevar_sumo needs Python 3.11 or newer")
        if name == "__version__":
            from importlib.metadata import version

            return version("safevar_sumo")
        if name not in _ROOM_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)

    def __dir__() -> list[str]:
        return sorted(__all__)
