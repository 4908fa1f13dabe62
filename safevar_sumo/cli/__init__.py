"""The commands: parse, call, print; one module for each kind of them."""

from safevar_sumo.cli import answers, catalogue, reference, simulate, study
from safevar_sumo.cli.program import main

__all__ = ["answers", "catalogue", "main", "reference", "simulate", "study"]
