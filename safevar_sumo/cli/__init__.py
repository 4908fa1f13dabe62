"""The command line: names and groups of commands, and commands that are made of functions."""

from safevar_sumo.cli.program import run_command_line as run_command_line
