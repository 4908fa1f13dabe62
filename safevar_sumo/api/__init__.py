"""The public library without the questions of `safevar_sumo.analysis`; `import safevar_sumo` re-exports the names."""

from safevar_sumo.analysis.subject import Results, load
from safevar_sumo.api.research_questions import Figures, Tables, figures, tables
from safevar_sumo.api.running import run
from safevar_sumo.api.simulation import Simulation, evaluate, simulate

__all__ = ["Figures", "Results", "Simulation", "Tables", "evaluate", "figures", "load", "run", "simulate", "tables"]
