"""The library as others use it: a study in, frames and figures out. The names here are those of `import safevar_sumo`."""

from safevar_sumo.api.questions import Figures, Tables, explain, figures, risk, rules, tables, tolerance
from safevar_sumo.api.results import Results, load
from safevar_sumo.api.running import run
from safevar_sumo.api.simulation import Simulation, evaluate, simulate

__all__ = ["Figures", "Results", "Simulation", "Tables", "evaluate", "explain", "figures", "load", "risk", "rules", "run",
           "simulate", "tables", "tolerance"]
