"""What searches find with few simulations: the surrogate beside NSGA-II and random search.

    python benchmarks/search.py [STUDY...] [--runs N] [--causes N]

Each run simulates 1,000 settings; its first ones are what it has found with fewer. Hypervolumes are
normalised by the front of all settings that any run has simulated. A distinct minimal cause is a
set of characteristics with the directions of their changes, found in up to 20 failures of a run,
those with the fewest changes; only the first `--causes` runs have this column, which takes long.
A12 is the probability that a run of the surrogate has more than a run of the other algorithm, with
its 95 % interval. Rows of a table in Markdown are printed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import moocore
import numpy as np

from safevar_sumo.campaign.evaluation import Task, evaluate_settings, system_of
from safevar_sumo.campaign.runs import (
    RunKey,
    algorithm_of,
    problem_of,
    random_generator_of,
)
from safevar_sumo.questions.causes import directions, find_minimal_causes
from safevar_sumo.questions.research_questions.fronts import hypervolume, normalised
from safevar_sumo.questions.research_questions.statistics import (
    compare_samples,
    effect_interval,
)
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import Study
from safevar_sumo.sumo.measuring import own_criterion

STUDIES = ("rain", "sun", "wear", "native")
ALGORITHMS = ("surrogate", "nsga2", "rs")
COUNTS = (100, 200, 500, 800, 1000)
"""Numbers of simulations."""
EXAMINED = 20
"""Failures of a run whose minimal causes are counted."""
ALL = 10**9
"""Settings that their causes may take: all subsets of their changes."""


class InThisProcess:
    """What `find_minimal_causes` needs of an evaluator."""

    def __init__(self, study: Study) -> None:
        self.characteristics = system_of(study).characteristics
        self._task = Task(study=study)
        self.phases = self  # which shows no progress

    def evaluate(self, settings: FloatArray, stage: str = "") -> Evaluations:
        return evaluate_settings(self._task, settings)

    @contextmanager
    def stage(self, *_: Any) -> Iterator[Any]:
        yield lambda expected: None


def simulated_by(study: Study, key: RunKey, evaluator: InThisProcess) -> Evaluations:
    """All that a run simulates, in order."""
    system = system_of(study)
    original = evaluator.evaluate(system.characteristics.original_settings)
    problem = problem_of(study, system, original)
    search = algorithm_of(key.algorithm, study).search(
        problem, random_generator_of(study, key)
    )
    batches = [evaluator.evaluate(next(search))]
    try:
        while True:
            batches.append(evaluator.evaluate(search.send(batches[-1])))
    except StopIteration:
        return Evaluations.concatenate(batches)


def hypervolumes_of(
    study: Study, runs: dict[RunKey, Evaluations]
) -> dict[RunKey, list[float]]:
    """The hypervolume of each run after each number of simulations."""
    scoring = system_of(study).measuring.scoring
    points = {key: scoring.values(found) for key, found in runs.items()}
    valid = {key: scoring.valid(found) for key, found in runs.items()}
    front = moocore.filter_dominated(
        np.concatenate([points[key][valid[key]] for key in runs])
    )
    return {
        key: [
            hypervolume(
                normalised(points[key][:count][valid[key][:count]], front),
                study.search.reference_point,
            )
            for count in COUNTS
        ]
        for key in runs
    }


def causes_of(study: Study, found: Evaluations, evaluator: Any) -> list[int]:
    """The number of distinct minimal causes of a run after each number of simulations."""
    criterion = own_criterion(study)
    known = dict[bytes, set[tuple[str, ...]]]()
    numbers = []
    for count in COUNTS:
        # The failures with the fewest, then the smallest changes.
        first = found.take(np.arange(min(count, len(found))))
        failures = first.take(criterion.of(first))
        order = np.lexsort([failures.f_diff, failures.f_num_diff])[:EXAMINED]
        settings = failures.settings[order]

        # Causes of those that are new.
        new = np.array([row for row in settings if row.tobytes() not in known])
        found_causes = (
            find_minimal_causes(evaluator, new, criterion, ALL) if len(new) else []
        )
        for row, causes in zip(new, found_causes, strict=True):
            kinds = {
                directions(evaluator.characteristics, cause.changes) for cause in causes
            }
            known[row.tobytes()] = kinds
        numbers.append(
            len(set[Any]().union(*(known[row.tobytes()] for row in settings)))
        )
    return numbers


def print_rows(study: Study, title: str, values: dict[RunKey, list[Any]]) -> None:
    """Print, for each number of simulations, the medians and A12 of the surrogate."""
    for column, count in enumerate(COUNTS):
        samples = {
            name: [row[column] for key, row in values.items() if key.algorithm == name]
            for name in ALGORITHMS
        }
        cells = [f"{np.median(sample):.3g}" for sample in samples.values()]
        for other in ALGORITHMS[1:]:
            test = compare_samples(samples["surrogate"], samples[other])
            low, high = effect_interval(test.effect_size, test.n1, test.n2, alpha=0.05)
            cells.append(f"{test.effect_size:.2f} ({low:.2f} to {high:.2f})")
        number = len(samples["surrogate"])
        print(
            f"| {study.name} | {title}, {number} runs | {count} |",
            " | ".join(cells),
            "|",
        )
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(
        description="What searches find with few simulations."
    )
    parser.add_argument("studies", nargs="*", default=STUDIES, metavar="STUDY")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--causes", type=int, default=5)
    arguments = parser.parse_args()
    print(
        "| study | median of | simulations |",
        " | ".join(ALGORITHMS),
        "| A12: nsga2 | A12: rs |",
    )
    print("| --- " * 8 + "|")
    for name in arguments.studies:
        search = {"algorithms": list(ALGORITHMS), "evaluations": COUNTS[-1]}
        study = read_study(name, search=search)
        evaluator = InThisProcess(study)
        keys = [RunKey(one, run) for one in ALGORITHMS for run in range(arguments.runs)]
        runs = {key: simulated_by(study, key, evaluator) for key in keys}
        print_rows(study, "hypervolume", hypervolumes_of(study, runs))
        few = {key: found for key, found in runs.items() if key.run < arguments.causes}
        causes = {key: causes_of(study, found, evaluator) for key, found in few.items()}
        print_rows(study, "distinct minimal causes", causes)


if __name__ == "__main__":
    main()
