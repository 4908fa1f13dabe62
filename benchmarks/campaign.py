"""What a campaign costs beside its simulations, and what more workers bring: ratios of one run on
one machine.

    python benchmarks/campaign.py [STUDY] [--runs N] [--evaluations N] [--turns N] [--json]

Time outside the simulation is search, journal and progress of a share that this process carries out
by itself. Workers start, and load the network, before the clock does. The floor is bare libsumo for
one population. What two workers bring is told by the clock: only an idle machine tells the truth.
`ceiling` is what two processes bring on this machine that only compute the same batches, and
`two_workers_of_ceiling` the share of it that two workers reach.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import psutil
from evaluation import bare
from measuring import Record, clock_seconds, print_records

from safevar_sumo.campaign import all_runs, evaluation, run_campaign
from safevar_sumo.campaign.evaluation import Task, evaluate_batch, evaluate_settings
from safevar_sumo.campaign.pool import Pool, open_pool
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import MAX_VEHICLES, drive_worst
from safevar_sumo.sumo.network import network_for
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import show_no_progress
from safevar_sumo.vehicles import CharacteristicSet

Computed = tuple[Task, FloatArray]
"""A task and its settings."""


class ThisProcess:
    """A worker that computes in this process, keeps the batches, and measures the processor time of
    simulations [s].
    """

    def __init__(self) -> None:
        self.batches: list[Computed] = []
        self.simulation = 0.0
        evaluation.evaluate_batch = self._evaluate

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if function is not evaluate_settings:
            self.batches, self.simulation = (
                [],
                0.0,
            )  # without the batches that warmed this process up
        future.set_result(function(*arguments))
        return future

    def cause_of_death(self, error: BaseException) -> str:
        return ""

    def end(self) -> None:
        evaluation.evaluate_batch = evaluate_batch

    def _evaluate(self, task: Task, settings: FloatArray) -> Evaluations:
        self.batches.append((task, settings))
        start = time.process_time()
        evaluations = evaluate_batch(task, settings)
        self.simulation += time.process_time() - start
        return evaluations


class Cost(NamedTuple):
    """What a campaign took [s of the clock, s of processors]."""

    clock: float
    processor: float


def processors() -> float:
    """Processor seconds of this process and all that it started, so far."""
    me = psutil.Process()
    return sum(sum(one.cpu_times()[:2]) for one in (me, *me.children(recursive=True)))


def drawn(study: Study, n: int, seed: int = 1) -> FloatArray:
    characteristics = CharacteristicSet.of(study)
    rng = np.random.default_rng(seed)
    return characteristics.filter(
        rng.uniform(
            characteristics.lower, characteristics.upper, (n, len(characteristics))
        )
    )


def campaign(study: Study, opened: AbstractContextManager[Pool]) -> Cost:
    """Carry out a study in a pool that is at work already."""
    with tempfile.TemporaryDirectory() as folder, opened as pool:
        task = Task(study=study, batch_size=MAX_VEHICLES)
        pool.map(
            evaluate_settings, [(task, drawn(study, MAX_VEHICLES))] * 4 * pool.workers
        )
        before, system = processors(), assemble(study)

        def carry_out() -> None:
            run_campaign(
                study,
                system,
                all_runs(study),
                Path(folder),
                pool,
                show_no_progress,
                print,
                MAX_VEHICLES,
            )

        clock = clock_seconds(carry_out)
        return Cost(clock, processors() - before)


def compute(batches: list[Computed]) -> None:
    for task, settings in batches:
        evaluate_batch(task, settings)


def ceiling(batches: list[Computed]) -> float:
    """How much faster two processes are than one that only compute the same batches."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:

        def together(n: int) -> None:
            for future in [processes.submit(compute, batches) for _ in range(n)]:
                future.result()

        together(2)
        return (
            2 * clock_seconds(lambda: together(1)) / clock_seconds(lambda: together(2))
        )


def floor(study: Study) -> float:
    """Processor seconds that bare libsumo takes to load and step the network for one setting of a
    population.
    """
    system, n = assemble(study), study.search.population
    steps = len(drive_worst(system, drawn(study, n)).trace.time)
    network = network_for(system.points[0].scenario)
    return float(np.median([bare(network, n, steps)[0] for _ in range(9)])) / n


@contextmanager
def two_dask_workers() -> Iterator[Pool]:
    """A cluster on this machine."""
    from distributed import LocalCluster

    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        open_pool(cluster=cluster.scheduler_address) as pool,
    ):
        yield pool


def turn(study: Study) -> dict[str, float]:
    """Every ratio once: what is compared is measured one right after the other."""
    alone = ThisProcess()
    whole = campaign(study, nullcontext(Pool(1, lambda place: alone)))
    alone.end()
    simulated, bare_each = (
        sum(len(settings) for _, settings in alone.batches),
        floor(study),
    )
    one, two = (campaign(study, open_pool(jobs)) for jobs in (1, 2))
    cluster = campaign(study, two_dask_workers())
    most = ceiling(alone.batches)
    return {
        "campaign": whole.processor / simulated / bare_each,
        "outside_simulation": 1 - alone.simulation / whole.processor,
        "two_workers": one.clock / two.clock,
        "ceiling": most,
        "two_workers_of_ceiling": one.clock / two.clock / most,
        "cluster": two.clock / cluster.clock,
    }


def records_of(study: Study, turns: int) -> Iterator[Record]:
    """Measure one and two workers, and two of a cluster; medians of some turns."""
    ratios = [turn(study) for _ in range(turns)]
    for measure in ratios[0]:
        yield Record(
            study.name,
            measure,
            study.search.population,
            statistics.median(one[measure] for one in ratios),
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description="What a campaign costs beside its simulations."
    )
    parser.add_argument("study", nargs="?", default="rain", metavar="STUDY")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--evaluations", type=int, default=500, help="of each run")
    parser.add_argument(
        "--turns",
        type=int,
        default=3,
        help="how often everything is measured; medians are told",
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    study = read_study(arguments.study)
    search = msgspec.structs.replace(
        study.search,
        algorithms=["nsga2"],
        runs=arguments.runs,
        evaluations=arguments.evaluations,
    )
    print_records(
        records_of(msgspec.structs.replace(study, search=search), arguments.turns),
        as_json=arguments.json,
    )


if __name__ == "__main__":
    main()
