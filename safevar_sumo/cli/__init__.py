"""The command line: names and groups of the commands, and a command for any function of the
library.
"""

from safevar_sumo.cli.program import run_command_line as run_command_line
