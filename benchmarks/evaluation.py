"""What an evaluation costs, beside what it could cost: ratios of one run on one machine.

    python benchmarks/evaluation.py [STUDY]

The floor is bare libsumo that loads and steps the same network as many steps with nobody at the wheel. The TraCI
socket is what one would write otherwise: one `sumo` process, reloaded for every setting, the same controller.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO

import libsumo
import numpy as np
import traci

from safevar_sumo.records import FloatArray
from safevar_sumo.simulation import System, assemble, evaluate, simulate
from safevar_sumo.simulation.batch import drive
from safevar_sumo.simulation.network import copied_network
from safevar_sumo.simulation.sumo import Engine, SumoWorld, sumo_command
from safevar_sumo.study import load_study

REPETITIONS = 7
POPULATIONS = (50, 200)


def median_seconds(measured: Callable[[], object], repetitions: int = REPETITIONS) -> float:
    """Median over repetitions, after one that does not count."""
    measured()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        measured()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def bare(system: System, n: int, steps: int) -> None:
    """Load n copies and step them; SUMO's own model drives."""
    libsumo.start(sumo_command(Engine.LIBSUMO, copied_network(system.scenario.network, n)))
    for _ in range(steps):
        libsumo.simulationStep()
    libsumo.close()


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
        drive(system, setting[np.newaxis], SumoWorld(traci, 1))


def main(study: str) -> None:
    """Measure a study's evaluations and print them as ratios."""
    system = assemble(load_study(study))
    characteristics = system.characteristics
    rng = np.random.default_rng(1)
    for n in POPULATIONS:
        settings = characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (n, len(characteristics))))
        steps = len(simulate(system, settings).trace.time)
        ours = median_seconds(lambda: evaluate(system, settings)) / n  # noqa: B023
        floor = median_seconds(lambda: bare(system, n, steps)) / n  # noqa: B023
        print(f"{study}, population of {n}, {steps} steps: {1e3 * ours:.2f} ms an evaluation")
        print(f"  against bare libsumo, the floor:  {ours / floor:6.2f} times as long")
        if n == POPULATIONS[0]:
            singles = median_seconds(lambda: [evaluate(system, one[np.newaxis]) for one in settings], 3) / n  # noqa: B023
            command = sumo_command(Engine.TRACI, copied_network(system.scenario.network, 1))
            with socket_to(command):
                socket = median_seconds(lambda: through_socket(system, settings[:10], command), 3) / 10  # noqa: B023
            print(f"  against batches of 1:             {singles / ours:6.2f} times as fast")
            print(f"  against a TraCI socket:           {socket / ours:6.2f} times as fast")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "rain")
