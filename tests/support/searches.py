"""Searches of formulas, step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import msgspec
import numpy as np
from numpy.random import default_rng

from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.search import ALGORITHMS, Algorithm, Problem, Search
from safevar_sumo.search.pymoo import pymoo_algorithm
from safevar_sumo.vehicles import Characteristic, CharacteristicSet, FeasibleRegion
from tests.support.made_up import SUN, made_up_evaluations

POPULATION = 20
REQUIRED: dict[str, dict[str, Any]] = {
    "pymoo:RNSGA2": {"ref_points": [[0.5, 0.3, 6.0], [1.0, 0.1, 4.0]]},
    "pymoo:RNSGA3": {"ref_points": [[0.5, 0.3, 6.0]], "pop_per_ref_point": 21},
}
"""Arguments without a default value."""
Evaluate = Callable[[CharacteristicSet, FloatArray], Evaluations]


def evaluated(
    characteristics: CharacteristicSet, settings: FloatArray, safety: FloatArray
) -> Evaluations:
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
    share = (settings - characteristics.lower) / (
        characteristics.upper - characteristics.lower
    )
    return evaluated(
        characteristics, settings, np.add.accumulate(share**2, axis=1)[:, -1]
    )


def steps_of(
    search: Search, evaluate: Callable[[FloatArray], Evaluations]
) -> Iterator[Any]:
    """The requests of a search, then its result."""
    answer: Any = None
    try:
        while True:
            asked = search.send(answer)
            yield asked
            answer = evaluate(asked)
    except StopIteration as end:
        yield end.value


def begun(
    algorithm: Algorithm,
    seed: int,
    evaluations: int,
    evaluate: Evaluate = sphere,
    scoring: Scoring = PUBLISHED_SCORING,
    characteristics: CharacteristicSet = SUN,
) -> Iterator[Any]:
    problem = Problem(
        region=FeasibleRegion(characteristics, ()),
        original=sphere(characteristics, characteristics.original_settings),
        evaluations=evaluations,
        population=POPULATION,
        scoring=scoring,
    )
    return steps_of(
        algorithm.search(problem, default_rng(seed)), partial(evaluate, characteristics)
    )


def built(name: str, **arguments: Any) -> Algorithm:
    """An algorithm of ours or of pymoo."""
    kind = ALGORITHMS.get(name) or pymoo_algorithm(name)
    return msgspec.convert(REQUIRED.get(name, {}) | arguments, kind)


TWO = CharacteristicSet(
    tuple(
        Characteristic(name=name, unit="-", original=50.0, lower=0.0, upper=100.0)
        for name in "ab"
    )
)


def problem() -> Problem:
    return Problem(
        region=FeasibleRegion(TWO, ()),
        original=evaluated(TWO, TWO.original_settings, np.array([5.0])),
        evaluations=1000,
        population=POPULATION,
    )
