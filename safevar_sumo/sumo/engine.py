"""Starts and stops SUMO; no other module imports libsumo or traci.

Both libraries have the same API: libsumo runs SUMO in this process, traci controls `sumo-gui` through a socket.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from enum import StrEnum
from io import StringIO
from pathlib import Path

from safevar_sumo.errors import EnvironmentFault, InputError, SimulationError
from safevar_sumo.sumo.network import CopiedNetwork, Network, varied_network
from safevar_sumo.sumo.world import Api, SumoWorld

CONNECTION_ATTEMPTS = 15
"""Number of times, once per second, that traci tries to connect to the SUMO process that it has started."""

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
}
"""Options with which SUMO starts, whatever options a network's file has: how far a vehicle comes at its speeds, and
what a collision is, depends on no user's file, and nobody who collides or waits leaves his place.
"""


class Engine(StrEnum):
    """What moves the vehicles: numpy in recorded scenes, or SUMO in this process.

    If an actor may react to the vehicles, RECORDED is the same as LIBSUMO.
    """

    RECORDED = "recorded"
    LIBSUMO = "sumo"


@contextmanager
def open_world(
    files: CopiedNetwork, n: int, options: Sequence[str] = (), create: Callable[[Api, int], SumoWorld] = SumoWorld
) -> Iterator[SumoWorld]:
    """Start SUMO on `n` copies of a network and its traffic; close SUMO at the end, also after an error. `create` makes
    the world of SUMO's API and the number of copies.

    Raises
    ------
    SimulationError
        With SUMO's message, if SUMO cannot load the network or simulate a step.
    """
    with redirect_stdout(sys.stderr):  # libsumo warns of a pyarrow of another version
        import libsumo
    with _open(libsumo, "SUMO"):
        try:
            libsumo.start(["sumo", *sumo_options(files), *options])
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise EnvironmentFault(f"SUMO does not start: {str(error).strip()}") from None
        yield create(libsumo, n)


@contextmanager
def open_varied_world(
    networks: Sequence[Network], options: Sequence[str] = (), create: Callable[[Api, int], SumoWorld] = SumoWorld
) -> Iterator[SumoWorld]:
    """Start SUMO on a copy of one network for each of N traffics; see `open_world`."""
    with varied_network(networks) as files, open_world(files, len(networks), options, create) as world:
        yield world


@contextmanager
def open_window(options: Mapping[str, object]) -> Iterator[Api]:
    """Start sumo-gui with options; yields TraCI.

    Raises
    ------
    InputError
        If there is no display.
    SimulationError
        If sumo-gui fails, or its window is closed.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("gui", "sumo-gui needs a display", "a desktop session, or DISPLAY in the environment")
    import sumo

    api = traci_api()
    command = [str(Path(sumo.SUMO_HOME) / "bin" / "sumo-gui")]
    command += [str(text) for option in options.items() for text in option]
    with _open(api, "sumo-gui"):
        with redirect_stdout(StringIO()), warnings.catch_warnings():  # traci prints that it waits for SUMO
            warnings.simplefilter("ignore")
            api.start(command, numRetries=CONNECTION_ATTEMPTS)
        yield api


@contextmanager
def _open(api: Api, program: str) -> Iterator[None]:
    """Report the errors of SUMO, and close SUMO at the end, even if it never started or its window was closed."""
    try:
        yield
    except (api.TraCIException, api.FatalTraCIError) as error:
        raise SimulationError(f"{program} failed: {str(error).strip() or 'it closed the connection'}") from None
    finally:
        with suppress(api.TraCIException, api.FatalTraCIError):
            api.close()


def traci_api() -> Api:
    import traci

    return traci


def sumo_options(files: CopiedNetwork) -> list[str]:
    """The options with which SUMO simulates copies of a network."""
    options = {
        "-c": files.options,
        "-n": files.network,
        "-r": files.traffic,
        "--verbose": "false",
        "--duration-log.disable": "true",
        "--duration-log.statistics": "false",
        "--no-step-log": "true",
        "--no-warnings": "true",
        "--xml-validation": "never",
        "--xml-validation.net": "never",
        "--xml-validation.routes": "never",
    }
    return [*own_options(), *(str(text) for option in options.items() for text in option)]


def own_options() -> list[str]:
    """`OWN_OPTIONS` as arguments of SUMO."""
    return [text for name, value in OWN_OPTIONS.items() for text in (f"--{name}", value)]
