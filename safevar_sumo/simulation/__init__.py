"""Simulation: many settings of a study in one SUMO process."""

from safevar_sumo.simulation.batch import evaluate, score, simulate
from safevar_sumo.simulation.kinematic import simulate_alone
from safevar_sumo.simulation.network import network_files, network_fingerprint
from safevar_sumo.simulation.sumo import Engine
from safevar_sumo.simulation.system import System, assemble, models_of

__all__ = ["Engine", "System", "assemble", "evaluate", "models_of", "network_files", "network_fingerprint", "score", "simulate",
           "simulate_alone"]
