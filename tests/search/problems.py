"""Problems with a known solution, and functions that run an algorithm on them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.search import ALGORITHMS, Algorithm, Problem, Search
from safevar_sumo.study import load_study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.vehicles.region import FeasibleRegion
from tests.made_up import made_up_evaluations

SUN = CharacteristicSet.of(load_study("sun"))
POPULATION = 20
Evaluate = Callable[[CharacteristicSet, FloatArray], Evaluations]


def evaluated(characteristics: CharacteristicSet, settings: FloatArray, safety: FloatArray) -> Evaluations:
    """Vehicles that stop, whatever their safety degree."""
    return made_up_evaluations(
        safety,
        settings=settings,
        outcome=np.full(len(settings), Outcome.STOPPED.value, dtype="U16"),
        collision_speed=np.full(len(settings), np.nan),
        f_diff=characteristics.largest_change(settings),
        f_num_diff=characteristics.number_changed(settings),
    )


def sphere(characteristics: CharacteristicSet, settings: FloatArray) -> Evaluations:
    """The nearer a setting is to the lower ends of the domains, the safer it is."""
    share = (settings - characteristics.lower) / (characteristics.upper - characteristics.lower)
    return evaluated(characteristics, settings, np.add.accumulate(share**2, axis=1)[:, -1])


def begun(
    name: str,
    seed: int,
    evaluations: int,
    characteristics: CharacteristicSet = SUN,
    algorithm: Algorithm | None = None,
    region: FeasibleRegion | None = None,
) -> Search:
    original = sphere(characteristics, characteristics.original[np.newaxis])
    problem = Problem(
        characteristics=characteristics,
        original=original,
        evaluations=evaluations,
        population=POPULATION,
        region=region,
    )
    return (algorithm or ALGORITHMS[name]()).search(problem, np.random.default_rng(seed))


def searched(
    name: str,
    seed: int,
    evaluations: int,
    characteristics: CharacteristicSet = SUN,
    evaluate: Evaluate = sphere,
    algorithm: Algorithm | None = None,
    region: FeasibleRegion | None = None,
) -> tuple[Evaluations, list[FloatArray]]:
    """Run an algorithm to its end; returns its result and all populations that it requested."""
    search = begun(name, seed, evaluations, characteristics, algorithm, region)
    populations = [next(search)]
    while True:
        try:
            populations.append(search.send(evaluate(characteristics, populations[-1])))
        except StopIteration as end:
            return end.value, populations
