"""Starts and stops SUMO; no other module imports libsumo or traci.

Both libraries have the same API: libsumo runs SUMO in this process, traci controls `sumo` or `sumo-gui` through a
socket.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from enum import StrEnum
from io import StringIO
from pathlib import Path

from safevar_sumo.errors import EnvironmentFault, InputError, SimulationError
from safevar_sumo.sumo.network import CopiedNetwork
from safevar_sumo.sumo.world import Api, SumoWorld

CONNECTION_ATTEMPTS = 15
"""Number of times, once per second, that traci tries to connect to the SUMO process that it has started."""


class Engine(StrEnum):
    """What moves the vehicles: numpy in recorded scenes (RECORDED), or SUMO.

    SUMO runs in this process (LIBSUMO), in another process (TRACI), or in another process with a window (GUI). If an
    actor may react to the vehicles, RECORDED is the same as LIBSUMO.
    """

    RECORDED = "recorded"
    LIBSUMO = "sumo"
    TRACI = "traci"
    GUI = "gui"


@contextmanager
def open_world(
    files: CopiedNetwork, n: int, engine: Engine = Engine.LIBSUMO, options: Sequence[str] = ()
) -> Iterator[SumoWorld]:
    """Start SUMO on `n` copies of a network and its traffic; close SUMO at the end, also after an error.

    Raises
    ------
    SimulationError
        With SUMO's message, if SUMO cannot load the network or simulate a step.
    """
    api = engine_api(engine)
    try:
        start_engine(api, engine, [*sumo_command(engine, files), *options])
        yield SumoWorld(api, n)
    except (api.TraCIException, api.FatalTraCIError) as error:
        raise SimulationError(f"SUMO failed: {str(error).strip() or 'it closed the connection'}") from None
    finally:
        stop_engine(api)


def engine_api(engine: Engine) -> Api:
    if engine is Engine.LIBSUMO:
        with redirect_stdout(sys.stderr):  # libsumo warns of a pyarrow of another version
            import libsumo

        return libsumo
    import traci

    return traci


def sumo_command(engine: Engine, files: CopiedNetwork) -> list[str]:
    """The command line that starts SUMO on copies of a network."""
    return [
        program_path(engine),
        "-c",
        str(files.options),
        "-n",
        str(files.network),
        "-r",
        str(files.traffic),
        "--no-step-log",
        "true",
        "--no-warnings",
        "true",
        "--xml-validation",
        "never",
        "--xml-validation.net",
        "never",
        "--xml-validation.routes",
        "never",
    ]


def start_engine(api: Api, engine: Engine, command: list[str]) -> None:
    if engine is Engine.LIBSUMO:
        try:
            api.start(command)
        except (api.TraCIException, api.FatalTraCIError) as error:
            raise EnvironmentFault(f"SUMO does not start: {str(error).strip()}") from None
        return
    has_display = sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if engine is Engine.GUI and not has_display:
        raise InputError("gui", "sumo-gui needs a display", "a desktop session, or DISPLAY in the environment")
    with redirect_stdout(StringIO()), warnings.catch_warnings():  # traci prints that it waits for SUMO
        warnings.simplefilter("ignore")
        api.start(command, numRetries=CONNECTION_ATTEMPTS)


def program_path(engine: Engine) -> str:
    """Path of the SUMO program of an engine."""
    if engine is Engine.LIBSUMO:
        return "sumo"
    import sumo

    return str(Path(sumo.SUMO_HOME) / "bin" / ("sumo-gui" if engine is Engine.GUI else "sumo"))


def stop_engine(api: Api) -> None:
    """Close SUMO, without errors if SUMO never started or the user closed its window."""
    with suppress(api.TraCIException, api.FatalTraCIError):
        api.close()
