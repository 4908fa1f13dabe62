"""What a campaign costs beside its simulations: one run of each of a study's algorithms on this machine.

    python benchmarks/campaign.py [STUDY [EVALUATIONS]]

Time outside the simulation is what a worker has over when the bare time of the same batches, computed by one process
with nothing else to do, is taken away: search, journal and hand-over, and what two workers cost each other. Workers
start, and build the network, before the clock does. Only an idle machine tells the truth on the clock; processor time
says on a busy one, too, what is not simulation.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import psutil

from safevar_sumo.campaign import RunKey, all_runs, carry_out
from safevar_sumo.computing import evaluate_batch, local_pool, packed
from safevar_sumo.computing.local import LocalPool
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import CharacteristicSet

RUNS = 2
"""Runs of each algorithm, so that two workers are not idle at the end."""


class Counting:
    """Hears how many settings were simulated, and says nothing."""

    simulated = 0

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        self.simulated += simulated

    def finished(self, key: RunKey, asked: int) -> None:
        pass

    def warned(self, message: str) -> None:
        pass


class Recording:
    """A pool that keeps the batches that went through it."""

    def __init__(self, pool: LocalPool) -> None:
        self._pool, self.workers = pool, pool.workers
        self.batches: list[FloatArray] = []

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        self.batches.append(settings)
        return self._pool.submit(study, settings)


def warm(pool: LocalPool, study: Study) -> None:
    """Have every worker started and the network built."""
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    settings = np.repeat(characteristics.original[np.newaxis], study.search.population, axis=0)
    for future in [pool.submit(packed(study), settings) for _ in range(4 * pool.workers)]:
        future.result()


class Cost(NamedTuple):
    """Seconds on the clock, and of processors."""

    clock: float
    processor: float


def processor_time() -> float:
    """Processor seconds of this process and its workers so far."""
    me = psutil.Process()
    return sum(sum(one.cpu_times()[:2]) for one in (me, *me.children()))


def cost(measured: Callable[[], object]) -> Cost:
    """What a call costs."""
    clock, processor = time.perf_counter(), processor_time()
    measured()
    return Cost(time.perf_counter() - clock, processor_time() - processor)


def campaign(study: Study, jobs: int) -> tuple[int, Cost, list[FloatArray]]:
    """How many settings a campaign simulates, what it costs, and its batches."""
    with tempfile.TemporaryDirectory() as folder, local_pool(jobs, study.search.time_limit) as pool:
        warm(pool, study)
        counting, recording = Counting(), Recording(pool)
        results = ResultsDirectory(Path(folder), study)
        spent = cost(lambda: carry_out(study, all_runs(study), results, recording, counting))
    return counting.simulated, spent, recording.batches


def simulation(study: Study, batches: list[FloatArray]) -> Cost:
    """What the same batches cost one process that has nothing else to do."""
    work = packed(study)
    evaluate_batch(work, batches[-1])
    return cost(lambda: [evaluate_batch(work, settings) for settings in batches])


def main(name: str, evaluations: int) -> None:
    """Measure one and two workers and print what they do in a second."""
    study = load_study(name)
    study = msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, runs=RUNS, evaluations=evaluations))
    rates = []
    for jobs in (1, 2):
        simulated, spent, batches = campaign(study, jobs)
        alone = simulation(study, batches)
        rates.append(simulated / spent.clock)
        print(f"{name}, {jobs} worker{'s' if jobs > 1 else ''}: {rates[-1]:.0f} evaluations/s; outside the simulation "
              f"{1 - alone.clock / (jobs * spent.clock):.0%} of the workers' time, {1 - alone.processor / spent.processor:.0%} of all "
              "processor time")
    print(f"2 workers against one: {rates[1] / rates[0]:.2f} times as fast")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "rain", int(sys.argv[2]) if len(sys.argv) > 2 else 2500)
