"""The library as others use it, beside the questions of `safevar_sumo.analysis`; the names here are those of `import safevar_sumo`."""

from safevar_sumo.analysis.subject import Results, load
from safevar_sumo.api.research_questions import Figures, Tables, figures, tables
from safevar_sumo.api.running import run
from safevar_sumo.api.simulation import Simulation, evaluate, simulate

__all__ = ["Figures", "Results", "Simulation", "Tables", "evaluate", "figures", "load", "run", "simulate", "tables"]
