"""The public library without the questions of `safevar_sumo.analysis`; `import safevar_sumo` re-exports the names."""

from safevar_sumo.analysis.subject import Results as Results, load as load
from safevar_sumo.api.research_questions import (
    Figures as Figures,
    Tables as Tables,
    figures as figures,
    tables as tables,
)
from safevar_sumo.api.running import run as run
from safevar_sumo.api.simulation import Simulation as Simulation, evaluate as evaluate, simulate as simulate
