"""Starts and stops SUMO. No other module imports libsumo or traci; only the process in which
`network_check` loads a network opens libsumo itself.

Both libraries have the same API: libsumo runs SUMO in this process, traci controls `sumo-gui`
through a socket.
"""

from __future__ import annotations

import locale
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, redirect_stdout, suppress
from io import StringIO

from safevar_sumo.errors import EnvironmentFault, InputError, SimulationError
from safevar_sumo.sumo.network import (
    CopiedNetwork,
    options_in,
    program_of_sumo,
)
from safevar_sumo.sumo.world import Api, SumoWorld

CONNECTION_ATTEMPTS = 15
"""Number of times, once per second, that traci tries to connect to the SUMO process that it has
started.
"""

OWN_OPTIONS = {
    "step-method.ballistic": "true",
    "ignore-accidents": "false",
    "collision.action": "warn",
    "collision.mingap-factor": "0",
    "collision.stoptime": "0",
    "collision.check-junctions": "true",
    "collision.check-junctions.mingap": "0",
    "intermodal-collision.action": "warn",
    "intermodal-collision.stoptime": "0",
    "time-to-teleport": "-1",
    "time-to-teleport.highways": "-1",
    "time-to-teleport.disconnected": "-1",
    "time-to-teleport.ride": "-1",
    "time-to-teleport.bidi": "-1",
    "time-to-teleport.railsignal-deadlock": "-1",
    "save-state.times": "",
    "save-state.period": "-1",
}
"""Options with which SUMO starts, whatever options a network's file states. So no user's file
decides how far a vehicle moves at its speeds and what a collision is, and SUMO never removes or
teleports an actor that collides or waits.
"""
OUTPUT = re.compile(r"(.+[.-])?output|netstate-dump|((error|message)-)?log")
"""SUMO's options that name a file to write, which would grow beside the user's network."""
NO_FILE = "NUL"
"""SUMO's name of no file."""
STEP_LENGTH = 0.05
"""Time step if neither the study nor its network's file states one [s]. SUMO's default, 1 s, is too
long for braking.
"""


@contextmanager
def open_in_process(options: Sequence[str]) -> Iterator[Api]:
    """Start SUMO in this process with options; yields libsumo.

    Raises
    ------
    SimulationError
        With SUMO's message, if SUMO cannot simulate a step.
    EnvironmentFault
        If SUMO does not start.
    """
    # libsumo prints a warning if pyarrow has another version: stdout is for results alone.
    with redirect_stdout(sys.stderr):
        import libsumo
    with _numbers_with_points(), _open(libsumo, "SUMO"):
        try:
            libsumo.start(["sumo", *options])
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise EnvironmentFault(
                f"SUMO does not start: {str(error).strip()}"
            ) from None
        yield libsumo


@contextmanager
def _numbers_with_points() -> Iterator[None]:
    """Within the block, this process reads and writes numbers as in the C locale. With a locale
    that user code has set, SUMO may expect a comma in place of the point.
    """
    user_locale = locale.setlocale(locale.LC_NUMERIC)
    locale.setlocale(locale.LC_NUMERIC, "C")
    try:
        yield
    finally:
        locale.setlocale(locale.LC_NUMERIC, user_locale)


@contextmanager
def open_window(options: Sequence[str]) -> Iterator[Api]:
    """Start sumo-gui with options; yields TraCI.

    Raises
    ------
    InputError
        If there is no display, or the extra `sumo` is not installed.
    SimulationError
        If sumo-gui fails, or its window is closed.
    """
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise InputError(
            "gui",
            "sumo-gui needs a display",
            "a desktop session, or DISPLAY in the environment",
        )
    program = program_of_sumo("sumo-gui", "gui")

    # The window opens with the first step.
    api = traci_api()
    with _open(api, "sumo-gui"):
        # traci prints that it waits for SUMO.
        with redirect_stdout(StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            api.start([program, *options], numRetries=CONNECTION_ATTEMPTS)
        yield api


Create = Callable[[Api, int], SumoWorld]
"""A function that returns the world of a simulation, from SUMO's API and the number of copies."""
Start = Callable[[Sequence[str]], AbstractContextManager[Api]]
"""A function that starts SUMO with options: `open_in_process` or `open_window`."""


@contextmanager
def open_world(
    files: CopiedNetwork,
    n: int,
    step: float | None = None,
    create: Create = SumoWorld,
    start: Start = open_in_process,
) -> Iterator[SumoWorld]:
    """Start SUMO on `n` copies of a network and its traffic; close SUMO at the end, also after an
    error. `step` is the time step [s] (None: the step in the network's options). `create` makes
    the world. Raises the errors of `start`.
    """
    with start(sumo_options(files, step)) as api:
        yield create(api, n)


@contextmanager
def _open(api: Api, program: str) -> Iterator[None]:
    """Turn an error of SUMO into a SimulationError, and close SUMO at the end, even if SUMO never
    started or its window was closed.
    """
    try:
        yield
    except (api.TraCIException, api.FatalTraCIError) as error:
        raise SimulationError(
            f"{program} failed: {str(error).strip() or 'it closed the connection'}"
        ) from None
    finally:
        with suppress(api.TraCIException, api.FatalTraCIError):
            api.close()


def traci_api() -> Api:
    import traci

    return traci


def sumo_options(files: CopiedNetwork, step: float | None = None) -> list[str]:
    """The options with which SUMO simulates copies of a network; see `open_world`."""
    # The command line overrules the user's options: what the simulation needs stands there.
    stated_options = options_in(files.options)
    if step is None:
        step = step_of(stated_options)
    options = own_options(stated_options) | {
        "step-length": repr(step),
        "configuration-file": str(files.options),
        "net-file": str(files.network),
        "route-files": str(files.traffic),
        "verbose": "false",
        "duration-log.disable": "true",
        "duration-log.statistics": "false",
        "no-step-log": "true",
        "no-warnings": "true",
        "xml-validation": "never",
        "xml-validation.net": "never",
        "xml-validation.routes": "never",
    }
    return as_arguments(options)


def own_options(stated: Mapping[str, str]) -> dict[str, str]:
    """The options that overrule the options `stated` by a network's file: `OWN_OPTIONS`, and no
    file for each option that names a file to write.
    """
    options = dict(OWN_OPTIONS)
    for option in stated:
        if OUTPUT.fullmatch(option):
            options[option] = NO_FILE
    return options


def step_of(stated: Mapping[str, str]) -> float:
    """The time step of a network [s], by the options `stated` by its file."""
    return float(stated.get("step-length", STEP_LENGTH))


def as_arguments(options: Mapping[str, str]) -> list[str]:
    """Options as arguments of SUMO."""
    arguments = []
    for name, value in options.items():
        arguments += [f"--{name}", value]
    return arguments
