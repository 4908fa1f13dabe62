"""Where NSGA-II ends on the published landscape, without any physics of ours.

    python docs/scripts/landscape.py rain rain_nsga2.csv rain_rs.csv rain_fuzzer.csv

A regression forest learns the safety degree from the rows of the published files. NSGA-II then
searches twice with the study's settings: on the forest's predictions, and on the study itself. The
first file holds the published solutions of NSGA-II, which the table compares with both.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from sklearn.ensemble import RandomForestRegressor

from safevar_sumo.metrics import METRICS
from safevar_sumo.questions.evaluator import open_evaluator
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.reference.rows import ReferenceData, evaluations_of, read_reference
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.search import Problem
from safevar_sumo.search.genetic import Nsga2
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

TREES, POPULATION = 300, 50
Evaluate = Callable[[FloatArray], Evaluations]


def predict(
    forest: RandomForestRegressor,
    characteristics: CharacteristicSet,
    settings: FloatArray,
) -> Evaluations:
    """Evaluations with the forest's safety degrees of settings, shape (M, n); other metrics are
    undefined.
    """
    undefined = np.full(len(settings), np.nan)
    metrics = dict.fromkeys(METRICS, undefined) | {
        SAFETY_DEGREE: forest.predict(settings)
    }
    return evaluations_of(ReferenceData(settings, metrics), characteristics)


def search(
    evaluate: Evaluate, characteristics: CharacteristicSet, evaluations: int, runs: int
) -> Evaluations:
    """The solutions of several runs of NSGA-II, which request their evaluations together."""
    original = evaluate(characteristics.original[np.newaxis])
    problem = Problem(
        region=FeasibleRegion(characteristics, ()),
        original=original,
        evaluations=evaluations,
        population=POPULATION,
    )
    searches = [
        Nsga2().search(problem, np.random.default_rng(run)) for run in range(runs)
    ]
    requests, solutions = [next(run) for run in searches], list[Evaluations]()
    while not solutions:
        evaluated = evaluate(np.concatenate(requests))
        ends = np.cumsum([len(request) for request in requests])[:-1]
        rows = np.split(np.arange(len(evaluated)), ends)
        requests = []
        for run, own_rows in zip(searches, rows, strict=True):
            try:
                requests.append(run.send(evaluated.take(own_rows)))
            except StopIteration as end:  # all runs end in the same generation
                solutions.append(end.value)
    return Evaluations.concatenate(solutions)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study")
    parser.add_argument(
        "files", nargs="+", type=Path, help="published rows, NSGA-II's first"
    )
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("--evaluations", type=int, default=5000)
    arguments = parser.parse_args()
    study = read_study(arguments.study)
    characteristics = CharacteristicSet.of(study)
    files = [
        evaluations_of(read_reference(path, characteristics), characteristics)
        for path in arguments.files
    ]
    published = Evaluations.concatenate(files)
    forest = RandomForestRegressor(TREES, random_state=0, n_jobs=-1).fit(
        published.settings, published.f_safe
    )
    run = partial(
        search,
        characteristics=characteristics,
        evaluations=arguments.evaluations,
        runs=arguments.runs,
    )
    with open_evaluator(study, None, None, lambda *progress: None) as evaluator:
        solutions = {
            "published": files[0],
            "on a forest of the published rows": run(
                partial(predict, forest, characteristics)
            ),
            "on this package's model": run(
                lambda settings: evaluator.evaluate(settings, "settings")
            ),
        }
    table = pd.DataFrame(
        {
            "solutions": len(of),
            "safety degree, mean [m]": of.f_safe.mean().round(2),
            "collisions [%]": (100 * np.mean(of.f_safe <= 0)).round(1),
            "characteristics changed": of.f_num_diff.mean().round(1),
            "f_diff": of.f_diff.mean().round(2),
        }
        for of in solutions.values()
    )
    print(table.set_axis(list(solutions), axis=0).T.to_string())


if __name__ == "__main__":
    main()
