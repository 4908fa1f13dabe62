"""What is simulated: a study, or what a results directory holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click

from safevar_sumo.cli.simulating import results_or_study, study_of
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.results import Handle, chosen_handle, position_of
from safevar_sumo.study import Study, study_names

Command = Callable[..., Any]


class Target(NamedTuple):
    """A study, how errors call it, and the solution of its results that is replayed, if any: handle, setting, row."""

    study: Study
    source: str
    handle: Handle | None = None
    setting: FloatArray | None = None
    recorded: dict[str, Any] | None = None


def replay_options(command: Command) -> Command:
    """The options that choose a solution of a results directory."""
    for option in (
            click.option("--smallest", "choice", flag_value="smallest", help="Replay the unsafe solution with the smallest changes."),
            click.option("--fewest", "choice", flag_value="fewest", help="Replay the unsafe solution with the fewest changes."),
            click.option("--most-severe", "choice", flag_value="most_severe", help="Replay the most severe solution."),
            click.option("--solution", metavar="ALG:RUN:N", help="Replay the N-th solution of a run, from 0, of a results directory.")):
        command = option(command)
    return command


def target_of(place: str, solution: str | None, choice: str | None) -> Target:
    """Read what a command is given: a study by name or path, or a results directory.

    Raises
    ------
    InputError
        If there is no such study, directory or solution.
    """
    if solution is not None and choice is not None:
        raise InputError("--solution", f"{solution!r} and --{choice.replace('_', '-')} both choose a solution", "one of them")
    asked = solution is not None or choice is not None
    if not asked:
        return Target(study_of(place), place)
    if place in study_names() and not Path(place).is_dir():
        raise InputError(place, "is a study and has no solutions", "a directory that the command study has written")
    from safevar_sumo.analysis import load_cases  # takes longer to load than the simulation

    case = results_or_study(place)
    if isinstance(case, Study):
        (case,) = load_cases([place])
    if solution is not None:
        handle = Handle.parse(solution)
    else:
        handle = chosen_handle(case.solutions, case.original["safety_degree"], str(choice), place)
    row = case.solutions.iloc[position_of(case.solutions, handle)]
    setting = row[list(case.characteristics.names)].to_numpy(dtype=float)
    return Target(case.study, place, handle, setting, {str(name): value for name, value in row.items()})
