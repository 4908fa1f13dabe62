"""What a campaign costs beside its simulations, and what more workers bring: ratios of one run on one machine.

    python benchmarks/campaign.py [STUDY] [--runs N] [--evaluations N] [--turns N] [--json]

Time outside the simulation is what is left of all processor time when that of the same batches, computed by one process
with nothing else to do, is taken away: search, journal and hand-over. Workers start, and load the network, before the
clock does. The floor is bare libsumo for one population. What two workers bring is told by the clock: only an idle
machine tells the truth. `ceiling` is what two processes bring on this machine that only compute the same batches, and
`two_workers_of_ceiling` the share of it that two workers reach.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import psutil
from evaluation import bare
from measuring import Record, clock_seconds, print_records, processor_seconds

from safevar_sumo.campaign import RunKey, all_runs, run_campaign
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import MAX_VEHICLES, simulate
from safevar_sumo.sumo.staging import stage_network
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.cluster import cluster_pool
from safevar_sumo.workers.evaluation import Pool, evaluate_batch, pack_study
from safevar_sumo.workers.identity import identity_of
from safevar_sumo.workers.local import local_pool

Batch = tuple[bytes, FloatArray]
"""A packed study, which says where its vehicles drive, and the settings."""


class Silent:
    """Hears how a campaign goes on, and says nothing."""

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        pass

    def finished(self, key: RunKey, asked: int) -> None:
        pass

    def warned(self, message: str) -> None:
        pass


class Recording:
    """A pool that keeps the batches that went through it."""

    def __init__(self, pool: Pool) -> None:
        self._pool = pool
        self.batches: list[Batch] = []

    @property
    def workers(self) -> int:
        return self._pool.workers

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        self.batches.append((study, settings))
        return self._pool.submit(study, settings)


class Cost(NamedTuple):
    """What a campaign took [s of the clock, s of processors], and its batches."""

    clock: float
    processor: float
    batches: list[Batch]

    @property
    def simulated(self) -> int:
        return sum(len(settings) for _, settings in self.batches)


def processors() -> float:
    """Processor seconds of this process and all that it started, so far."""
    me = psutil.Process()
    return sum(sum(one.cpu_times()[:2]) for one in (me, *me.children(recursive=True)))


def drawn(study: Study, n: int, seed: int = 1) -> FloatArray:
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    rng = np.random.default_rng(seed)
    return characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (n, len(characteristics))))


def campaign(study: Study, opened: AbstractContextManager[Pool]) -> Cost:
    """Carry out a study in a pool that is at work already."""
    with tempfile.TemporaryDirectory() as folder, opened as pool:
        for future in [pool.submit(pack_study(study), drawn(study, MAX_VEHICLES)) for _ in range(4 * pool.workers)]:
            future.result()
        recording = Recording(pool)
        before = processors()
        results = ResultsDirectory(Path(folder), study, identity_of(study, assemble(study)))
        clock = clock_seconds(lambda: run_campaign(study, all_runs(study), results, recording, Silent(), MAX_VEHICLES,
                                                   engine=Engine.RECORDED))
        return Cost(clock, processors() - before, recording.batches)


def simulation(batches: list[Batch]) -> float:
    """Processor seconds of the same batches, in recorded scenes and in SUMO, in one process that has nothing else to do."""
    compute(batches[:1])
    return processor_seconds(lambda: compute(batches))


def compute(batches: list[Batch]) -> None:
    for work, settings in batches:
        evaluate_batch(work, settings)


def ceiling(batches: list[Batch]) -> float:
    """How much faster two processes are than one that only compute the same batches."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:
        def together(n: int) -> None:
            for future in [processes.submit(compute, batches) for _ in range(n)]:
                future.result()

        together(2)
        return 2 * clock_seconds(lambda: together(1)) / clock_seconds(lambda: together(2))


def floor(study: Study) -> float:
    """Processor seconds that bare libsumo takes to load and step the network for one setting of a population."""
    system, n = assemble(study), study.search.population
    steps = len(simulate(system, drawn(study, n)).trace.time)
    network = stage_network(system.points[0].scenario)
    return float(np.median([bare(network, n, steps)[0] for _ in range(9)])) / n


@contextmanager
def two_dask_workers(study: Study) -> Iterator[Pool]:
    """A cluster on this machine."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, \
            cluster_pool(cluster.scheduler_address, study.search.time_limit) as pool:
        yield pool


def turn(study: Study) -> dict[str, float]:
    """Every ratio once: what is compared is measured one right after the other."""
    one = campaign(study, local_pool(1, study.search.time_limit))
    alone, bare_each = simulation(one.batches), floor(study)
    two = campaign(study, local_pool(2, study.search.time_limit))
    cluster = campaign(study, two_dask_workers(study))
    most = ceiling(one.batches)
    return {"campaign": one.processor / one.simulated / bare_each, "outside_simulation": 1 - alone / one.processor,
            "two_workers": one.clock / two.clock, "ceiling": most, "two_workers_of_ceiling": one.clock / two.clock / most,
            "cluster": two.clock / cluster.clock}


def records_of(study: Study, turns: int) -> Iterator[Record]:
    """Measure one and two workers, and two of a cluster; medians of some turns."""
    ratios = [turn(study) for _ in range(turns)]
    for measure in ratios[0]:
        yield Record(study.name, measure, study.search.population, statistics.median(one[measure] for one in ratios))


def main() -> None:
    parser = argparse.ArgumentParser(description="What a campaign costs beside its simulations.")
    parser.add_argument("study", nargs="?", default="rain", metavar="STUDY")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--evaluations", type=int, default=500, help="of each run")
    parser.add_argument("--turns", type=int, default=3, help="how often everything is measured; medians are told")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    study = load_study(arguments.study)
    search = msgspec.structs.replace(study.search, algorithms=["nsga2"], runs=arguments.runs, evaluations=arguments.evaluations)
    print_records(records_of(msgspec.structs.replace(study, search=search), arguments.turns), as_json=arguments.json)


if __name__ == "__main__":
    main()
