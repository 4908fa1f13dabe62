"""What all benchmarks share: a record of a ratio, how it is printed, and times that a busy machine
disturbs least.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

REPETITIONS = 7

MEANINGS = {
    "bare_libsumo": (
        "an evaluation takes so many times what bare libsumo takes to load and step the same"
        " network"
    ),
    "stepping_alone": "an evaluation takes so many times what bare libsumo takes to step it",
    "replayed": (
        "the same with a vehicle and an ADS that compute nothing: what no model can go below"
    ),
    "batches_of_1": "so many times as fast as one setting after the other",
    "traci_socket": (
        "so many times as fast as one setting after the other through a TraCI socket, the network"
        " reloaded for each"
    ),
    "scalar_ads": (
        "an evaluation with a ScalarAds that does next to nothing takes so many times one with the"
        " study's own ADS"
    ),
    "campaign": "an evaluation of a campaign takes so many times a core's time of bare libsumo",
    "two_workers": "two workers are so many times as fast as one",
    "ceiling": "two processes that only compute are so many times as fast as one",
    "two_workers_of_ceiling": "share of that ceiling that two workers reach",
    "outside_simulation": "share of all processor time that is not simulation",
    "cluster": "a Dask cluster of two workers is so many times as fast as two processes",
    "answer": "an answer takes so many times what its simulations cost in large batches",
    "answer_simulating": "its simulations take so many times that",
    "answer_again": "the same command, asked again, takes so many times that with the cache",
    "growth_time": "the last evaluations take so many times what the first took",
    "growth_memory": (
        "a worker holds so many times the memory that it held after the first 5,000 evaluations"
    ),
    "growth_mebibytes": "a worker holds so many MiB more than after the first 5,000 evaluations",
}


class Record(NamedTuple):
    """One ratio of a study, with populations of a size."""

    study: str
    measure: str
    population: int
    ratio: float


def print_records(records: Iterable[Record], *, as_json: bool) -> None:
    """Print records as they come, or all of them as JSON."""
    if as_json:
        print(json.dumps([record._asdict() for record in records], indent=2))
        return
    for record in records:
        print(
            f"{record.study:8} {record.population:7d}  {record.measure:18} {record.ratio:7.2f}  "
            f"{MEANINGS[record.measure]}",
            flush=True,
        )


def medians_in_turn(
    *measured: Callable[[], float], repetitions: int = REPETITIONS
) -> list[float]:
    """Median seconds that every call tells, called in turns, so that what disturbs one disturbs the
    others too.
    """
    turns = [[one() for one in measured] for _ in range(repetitions)]
    return [statistics.median(times) for times in zip(*turns, strict=True)]


def processor_seconds(work: Callable[[], object]) -> float:
    """Seconds of this process's processor time."""
    start = time.process_time()
    work()
    return time.process_time() - start


def clock_seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
