"""What an evaluation costs, beside what it could cost: ratios of one run on one machine.

    python benchmarks/evaluation.py [STUDY...] [--json]

The floor is bare libsumo that loads and steps the same network as many steps with nobody at the
wheel; an evaluation finds its scene recorded, as all but the first of a worker does. The TraCI
socket is what one would write otherwise: one `sumo` process, reloaded for every setting, the same
controller; who starts a process for each waits a second more, as traci tries again only then. What
is compared takes turns, and where one process does the work its processor time counts: so a machine
that others use too disturbs them little.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import sumo
import traci
from measuring import (
    Record,
    clock_seconds,
    medians_in_turn,
    print_records,
    processor_seconds,
)

from safevar_sumo.ads import PerVehicleAds, ScalarAds
from safevar_sumo.plugins import UserCode
from safevar_sumo.records import FloatArray, Observation
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.sumo.batch import observer_of
from safevar_sumo.sumo.drive import drive
from safevar_sumo.sumo.engine import open_world, sumo_options
from safevar_sumo.sumo.matrix import drive_and_score, drive_worst
from safevar_sumo.sumo.network import copied_network, network_for
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.world import SumoWorld

POPULATIONS = (50, 200, 1000, 4000)
SOCKET_SETTINGS = 10
"""So many settings go through the socket."""


class Coasting(ScalarAds):
    """The least that an ADS for one vehicle can do."""

    def drive(self, seen: Observation) -> tuple[float, float]:
        return (0.5, 0.0) if seen.gap > 10 else (0.0, 1.0)


class Replayed:
    """A vehicle or an ADS that computes in its first run alone, and returns the same in every later
    one of the same settings.

    `begins` is the method that a run begins with, `goes_on` the one of every step.
    """

    def __init__(self, model: Any, begins: str, goes_on: str) -> None:
        self._model, self._tape, self._next = model, list[Any](), iter(())

        def begun(*given: Any) -> Any:
            self._next = iter(self._tape[:])
            return getattr(model, begins)(*given)

        def gone_on(*given: Any) -> Any:
            kept = next(self._next, None)
            if kept is None:
                self._tape.append(kept := getattr(model, goes_on)(*given))
            return kept

        setattr(self, begins, begun)
        setattr(self, goes_on, gone_on)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)


def settings_of(system: System, n: int) -> FloatArray:
    """The same settings in every run of a benchmark."""
    characteristics = system.characteristics
    rng = np.random.default_rng(1)
    return characteristics.filter(
        rng.uniform(
            characteristics.lower, characteristics.upper, (n, len(characteristics))
        )
    )


def bare(network: str, n: int, steps: int) -> tuple[float, float]:
    """Processor seconds of loading n copies, stepping and closing them with SUMO's own model at the
    wheel; and of the steps alone.
    """
    stepping = 0.0

    def whole() -> None:
        nonlocal stepping
        with open_world(copied_network(network, n), n):
            stepping = processor_seconds(
                lambda: [libsumo.simulationStep() for _ in range(steps)]
            )

    return processor_seconds(whole), stepping


def warm(system: System, settings: FloatArray) -> float:
    """Processor seconds of an evaluation on a network that is loaded."""
    drive_and_score(system, settings)
    return processor_seconds(lambda: drive_and_score(system, settings))


@contextmanager
def socket_to(command: list[str]) -> Iterator[None]:
    """A TraCI connection to a `sumo` process, whose start is not measured."""
    with redirect_stdout(StringIO()):
        traci.start(command)
    try:
        yield
    finally:
        traci.close()


def through_socket(system: System, settings: FloatArray, command: list[str]) -> None:
    """One setting after the other through one TraCI connection, the network reloaded each time."""
    for setting in settings:
        traci.load(command[1:])
        world = SumoWorld(traci, 1)
        drive(
            system,
            setting[None],
            world,
            observer_of(system.points[0].scenario, world, None),
        )


def records_of(
    study: str, populations: tuple[int, ...] = POPULATIONS
) -> Iterator[Record]:
    """Measure a study's evaluations."""
    system = assemble(read_study(study))
    network = network_for(system.points[0].scenario)
    for n in populations:
        settings = settings_of(system, n)
        steps = len(drive_worst(system, settings).trace.time)
        floors = [bare(network, n, steps) for _ in range(2)]

        def floor(
            floors: list[tuple[float, float]] = floors, n: int = n, steps: int = steps
        ) -> float:
            floors.append(bare(network, n, steps))
            return floors[-1][0]

        loading, ours = medians_in_turn(floor, partial(warm, system, settings))
        stepping = statistics.median(alone for _, alone in floors[2:])
        yield Record(study, "bare_libsumo", n, ours / loading)
        yield Record(study, "stepping_alone", n, ours / stepping)
        if n <= 200:
            replayed = replace(
                system,
                vehicle=Replayed(system.vehicle, "prepare", "advance"),
                ads=Replayed(system.ads, "start", "drive"),
            )
            loading, ours = medians_in_turn(floor, partial(warm, replayed, settings))
            yield Record(study, "replayed", n, ours / loading)
            yield from beside_others(study, system, settings)


def beside_others(study: str, system: System, settings: FloatArray) -> Iterator[Record]:
    """Against other ways to do the same, on the clock."""
    n, few = len(settings), settings[:SOCKET_SETTINGS]
    scalar = replace(system, ads=PerVehicleAds(Coasting, UserCode("ads")))
    drive_and_score(system, settings)
    program = str(Path(sumo.SUMO_HOME) / "bin" / "sumo")
    command = [
        program,
        *sumo_options(copied_network(network_for(system.points[0].scenario), 1)),
    ]
    with socket_to(command):
        through_socket(system, few[:1], command)
        together, alone, coasting, socket = medians_in_turn(
            lambda: clock_seconds(lambda: drive_and_score(system, settings)),
            lambda: clock_seconds(
                lambda: [drive_and_score(system, one[None]) for one in few]
            ),
            lambda: clock_seconds(lambda: drive_and_score(scalar, settings)),
            lambda: clock_seconds(lambda: through_socket(system, few, command)),
            repetitions=5,
        )
    yield Record(study, "batches_of_1", n, alone / len(few) / (together / n))
    yield Record(study, "scalar_ads", n, coasting / together)
    yield Record(study, "traci_socket", n, socket / len(few) / (together / n))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="What an evaluation costs, beside what it could cost."
    )
    parser.add_argument(
        "studies", nargs="*", default=["rain", "lgsvl"], metavar="STUDY"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    print_records(
        (record for study in arguments.studies for record in records_of(study)),
        as_json=arguments.json,
    )
