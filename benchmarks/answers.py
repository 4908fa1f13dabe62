"""What a person waits for an answer, beside its simulations: ratios of one run on one machine.

    python benchmarks/answers.py [COMMAND...] [--json]

Each command, such as "tolerance rain", is carried out as typed, by one worker in this process. Its
processor time is compared with a floor: the number of its simulations, a vehicle at a point, times
what one costs in a large batch of the same study. What lies above 1 is not simulation, or
simulation in small batches. `answer_again` is the processor time of the same command asked again,
which finds its simulations, as a share of the first time. Results of "study rain" go into a
temporary directory, which later commands find as results/rain.
"""

from __future__ import annotations

import argparse
import os
import shlex
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from campaign import drawn
from measuring import Record, print_records, processor_seconds

from safevar_sumo.campaign import evaluation, local
from safevar_sumo.campaign.evaluation import Task, evaluate_batch, system_of
from safevar_sumo.cli.program import run_command_line
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import most_in_memory

COMMANDS = (
    "study rain",
    "explain results/rain",
    "tolerance rain",
    'tolerance wear --limits "treadDepth >= 3" --quick',
    'tolerance wear --limits "treadDepth >= 3"',
    "tolerance sun --ranges",
    "tolerance wear --ranges",
    "permit wear --set treadDepth=3 --set payload=300 --set brakeTorque=0.9",
    "repair wear --promise all",
    "report results/rain",
)
"""The questions that people wait for; `report` asks several."""


class ThisProcess:
    """A worker in this process."""

    def __init__(self, last_words: Path) -> None: ...

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*arguments))
        return future

    def cause_of_death(self, error: BaseException) -> str:
        return ""

    def end(self) -> None: ...


class Counted:
    """Counts the simulations of each study, and measures their processor time [s]."""

    def __init__(self) -> None:
        self.simulations, self.studies = Counter[str](), dict[str, Study]()
        self.seconds = 0.0

    def evaluate(self, task: Task, rows: FloatArray) -> Evaluations:
        points = len(task.selection.of(system_of(task.study)).points)
        self.studies.setdefault(task.study.name, task.study)
        self.simulations[task.study.name] += (
            vehicles_each(task.study) * points * len(rows)
        )
        start = time.process_time()
        evaluations = evaluate_batch(task, rows)
        self.seconds += time.process_time() - start
        return evaluations


def vehicles_each(study: Study) -> int:
    """Vehicles that drive for a setting: the original one in the same encounter, too, where
    encounters are searched.
    """
    return 2 if study.ranges else 1


def seconds_of_one(study: Study) -> float:
    """Processor seconds of a simulation of a study in a large batch."""
    system = system_of(study)
    each = len(system.points) * vehicles_each(study)
    task, rows = Task(study=study), drawn(study, max(most_in_memory(system) // each, 1))
    evaluate_batch(task, rows)
    times = [processor_seconds(lambda: evaluate_batch(task, rows)) for _ in range(5)]
    return statistics.median(times) / (len(rows) * each)


def records_of(command: str) -> Iterator[Record]:
    """Carry out a command, and compare it with its simulations."""
    counted, words = Counted(), [*shlex.split(command), "--jobs", "1"]

    def carry_out() -> None:
        sys.argv = ["safevar-sumo", *words]
        with redirect_stdout(StringIO()):
            try:
                run_command_line()
            except SystemExit as end:
                if end.code not in (0, 3, None):
                    raise

    local.ProcessWorker, evaluation.evaluate_batch = ThisProcess, counted.evaluate
    seconds = processor_seconds(carry_out)
    evaluation.evaluate_batch = evaluate_batch
    simulations = counted.simulations.total()
    floor = sum(
        number * seconds_of_one(counted.studies[name])
        for name, number in counted.simulations.items()
    )
    print(
        f"{command}: {seconds:.1f} s of a processor, {floor:.1f} s for its simulations",
        file=sys.stderr,
    )
    yield Record(command, "answer", simulations, seconds / floor)
    yield Record(command, "answer_simulating", simulations, counted.seconds / floor)
    if not command.startswith("study"):
        yield Record(command, "answer_again", 0, processor_seconds(carry_out) / seconds)


def records_in(folder: str, command: str) -> Iterator[Record]:
    """The same with an empty cache of simulations, so that no command finds another one's."""
    os.environ["SAFEVAR_CACHE"] = tempfile.mkdtemp(prefix="simulations-", dir=folder)
    yield from records_of(command)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="What an answer costs beside its simulations."
    )
    parser.add_argument("commands", nargs="*", default=COMMANDS, metavar="COMMAND")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        print_records(
            (
                record
                for command in arguments.commands
                for record in records_in(folder, command)
            ),
            as_json=arguments.json,
        )


if __name__ == "__main__":
    main()
