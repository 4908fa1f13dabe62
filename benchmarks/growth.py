"""Whether a worker that lives long gets slower or larger: ratios of one run on one machine.

    python benchmarks/growth.py [STUDY] [--evaluations N] [--json]

A worker answers batches of settings drawn at random; its processor time and its resident memory are
those of its process.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import psutil
from campaign import drawn
from measuring import Record, print_records

from safevar_sumo.campaign.evaluation import Task, evaluate_settings
from safevar_sumo.campaign.pool import open_pool
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import MAX_VEHICLES

FIRST = 5000
"""Evaluations after which a worker counts as grown up."""


def records_of(study: Study, evaluations: int) -> Iterator[Record]:
    """Measure the first and the last `FIRST` evaluations of one worker, and its memory after
    both.
    """
    task, spans = Task(study=study, batch_size=MAX_VEHICLES), []
    with open_pool(1) as pool:
        pool.map(evaluate_settings, [(task, drawn(study, MAX_VEHICLES))])
        worker = next(
            child
            for child in psutil.Process().children()
            if "spawn_main" in " ".join(child.cmdline())
        )
        first = 0
        for done in range(0, evaluations, FIRST):
            before = sum(worker.cpu_times()[:2])
            for batch in range(FIRST // MAX_VEHICLES):
                pool.map(
                    evaluate_settings,
                    [(task, drawn(study, MAX_VEHICLES, seed=done + batch))],
                )
            spans.append(sum(worker.cpu_times()[:2]) - before)
            first = first or worker.memory_info().rss
        last = worker.memory_info().rss
    yield Record(study.name, "growth_time", MAX_VEHICLES, spans[-1] / spans[0])
    yield Record(study.name, "growth_memory", MAX_VEHICLES, last / first)
    yield Record(study.name, "growth_mebibytes", MAX_VEHICLES, (last - first) / 2**20)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Whether a worker that lives long gets slower or larger."
    )
    parser.add_argument("study", nargs="?", default="rain", metavar="STUDY")
    parser.add_argument("--evaluations", type=int, default=100_000)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    print_records(
        records_of(read_study(arguments.study), arguments.evaluations),
        as_json=arguments.json,
    )
