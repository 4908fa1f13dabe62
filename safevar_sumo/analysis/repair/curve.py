"""The exchange rate between promised wear and earlier braking: repairs for ten promises of one characteristic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from safevar_sumo.analysis.evaluator import sobol_points
from safevar_sumo.analysis.repair.answer import Exchange, Repair
from safevar_sumo.analysis.repair.price import Price
from safevar_sumo.analysis.repair.problem import Problem
from safevar_sumo.analysis.repair.smallest import Search, Subset
from safevar_sumo.records import FloatArray

CURVE_PROMISES, CURVE_VEHICLES = 10, 32
"""Promises of a curve; Sobol points of each, besides its corners."""


def exchange_rate(
    problem: Problem, points: int, price: Callable[[FloatArray], Price], name: str, repairs: Sequence[Repair]
) -> list[Exchange]:
    """How much earlier the ADS has to brake for promises of a characteristic, from new to the end of its wear.

    The parameters of the first repair change, or each by itself without a repair.
    """
    promise = problem.promise
    column, seed = promise.characteristics.names.index(name), problem.study.search.seed
    worn = promise.characteristics.members[column]
    falls = worn.original - worn.lower >= worn.upper - worn.original
    names = [parameter.name for parameter in problem.parameters]
    changed = tuple(names.index(value) for value in repairs[0].values) if repairs else ()
    subsets = [changed] if changed else [(number,) for number in range(len(names))]
    exchanges = []
    for end in np.linspace(worn.original, worn.lower if falls else worn.upper, CURVE_PROMISES + 1)[1:].tolist():
        lower, upper = promise.lower.copy(), promise.upper.copy()
        lower[column], upper[column] = (end, worn.original) if falls else (worn.original, end)
        part = replace(promise, lower=lower, upper=upper)
        sobol = part.settings(sobol_points(CURVE_VEHICLES, len(part.columns), seed))
        vehicles = np.concatenate([part.corners(seed), sobol])
        vehicles = vehicles[problem.evaluator.region.feasible(vehicles)]
        degrees = problem.degrees(np.tile(problem.today, (len(vehicles), 1)), vehicles, "exchange rate")
        vehicles = vehicles[np.argsort(degrees, kind="stable")]
        if (degrees >= problem.margin).all():
            exchanges.append(Exchange(name, end, 0.0, True))
            continue
        found = dict[Subset, FloatArray]()
        if problem.repairable(vehicles).all():
            search = Search(problem, vehicles, list(range(points)))
            found = search.smallest(subsets, dict.fromkeys(subsets, 1.0), {})
        prices = [one.worst for one in map(price, found.values()) if one.worst is not None]
        exchanges.append(Exchange(name, end, min(prices, default=None), bool(found)))
    return exchanges
