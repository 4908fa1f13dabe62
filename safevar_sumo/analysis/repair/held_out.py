"""What a repair has not seen: other weathers, a second vehicle model, other sets of the vehicle's parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.analysis.model_spread import studies_of_sets
from safevar_sumo.analysis.opinion.compute import assemble_both_systems
from safevar_sumo.analysis.repair.problem import Problem, degrees_of
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.scenarios import WEATHERS, equals_clear
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble

WORST_VEHICLES, SECOND_VEHICLES = 16, 11
"""Number of the worst vehicles within the promise that are driven in other weathers and by other sets of parameters;
with the second vehicle model."""


def check_unseen(problem: Problem, values: Mapping[str, float], vehicles: FloatArray) -> JsonObject:
    """Counts of `safe` among `all` the worst vehicles, for each check that the study allows; `vehicles` are sorted.

    In other weathers only vehicles count that full braking at the first possible moment keeps safe there.
    """
    study = with_parameters(problem.study, values)
    system = assemble(study)
    settings = vehicles[:WORST_VEHICLES]
    own = {point.weather.name for point in system.points}
    others = [weather for name, weather in WEATHERS.items() if name not in own and not equals_clear(weather)]
    best_driver = assemble(problem.best_driver.study).ads
    checks: JsonObject = {"weathers": {}}
    for number, weather in enumerate(others):
        problem.evaluator.progress("other weathers", number, len(others))
        points = {replace_in_name(point.name, weather.name): point._replace(weather=weather) for point in system.points}
        there = replace(
            system, matrix=tuple(point._replace(name=name) for name, point in points.items()), weather=weather
        )
        try:
            able = degrees_of(evaluate(replace(there, ads=best_driver), settings)) >= problem.margin
            checks["weathers"][weather.name] = _count(there, settings[able], problem.margin)
        except UserCodeError:
            continue  # a user's vehicle that knows no wet road
    try:
        ours, second = assemble_both_systems(study)
        problem.evaluator.progress("second vehicle model", 0, 1)
        checks["second_vehicle"] = _count(replace(ours, vehicle=second), vehicles[:SECOND_VEHICLES], problem.margin)
    except InputError:
        checks["second_vehicle"] = None  # the model is not installed, or cannot represent the vehicle
    checks["fitted_sets"] = None
    if study.spread:
        sets = studies_of_sets(replace_in(study, spread=_without(study.spread, values)))
        worst = [
            bool((degrees_of(evaluate(assemble(one), settings)) >= problem.margin).all())
            for one in sets
            if study.spread
        ]
        checks["fitted_sets"] = {"all": len(worst), "safe": sum(worst)}
    return checks


def replace_in_name(name: str, weather: str) -> str:
    """The name of a point in another weather."""
    return ", ".join([*name.split(", ")[:-1], weather])


def _without(spread: Mapping[str, Sequence[float]], values: Mapping[str, float]) -> dict[str, list[float]]:
    return {key: list(row) for key, row in spread.items() if key.removeprefix("ads.parameters.") not in values}


def _count(system: System, settings: FloatArray, margin: float) -> JsonObject:
    """How many vehicles a system keeps safe."""
    if not len(settings):
        return {"all": 0, "safe": 0}
    degrees = degrees_of(evaluate(system, settings))
    return {"all": len(settings), "safe": int(np.count_nonzero(degrees >= margin))}
