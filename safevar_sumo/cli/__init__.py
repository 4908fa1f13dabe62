"""The commands: parse, call, print; one module for each kind of command, loaded when one of its commands is called."""

from safevar_sumo.cli.program import main as main
