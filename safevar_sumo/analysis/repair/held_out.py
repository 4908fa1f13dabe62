"""What a repair has not seen: other weathers, a second vehicle model, other sets of the vehicle's parameters (step
6).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.analysis.model_spread import studies_of_sets
from safevar_sumo.analysis.opinion.compute import assemble_both_systems
from safevar_sumo.analysis.repair.price import Values
from safevar_sumo.analysis.repair.problem import PREFIX, Problem, degrees_of
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.scenarios import WEATHERS, equals_clear
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble

WORST_VEHICLES, SECOND_VEHICLES = 16, 11
"""Number of the worst vehicles within the promise that are driven in other weathers and by other sets of parameters;
with the second vehicle model.
"""


def check_unseen(problem: Problem, values: Values, vehicles: FloatArray) -> JsonObject:
    """Counts of `safe` among `all` the worst vehicles, for each check that the study allows; `vehicles` are sorted.

    In other weathers only vehicles count that full braking at the first possible moment keeps safe there.
    """
    study, settings = with_parameters(problem.study, values), problem.promise.settings(vehicles[:WORST_VEHICLES])
    system, show = assemble(study), problem.evaluator.progress
    best_driver = assemble(problem.best_driver.study).ads

    def are_safe(system: System, settings: FloatArray) -> BoolArray:
        if not len(settings):
            return np.zeros(0, dtype=bool)
        return np.asarray(degrees_of(evaluate(system, settings)) >= problem.margin)

    own = {point.weather.name for point in system.points}
    others = [one for name, one in WEATHERS.items() if name not in own and not equals_clear(one)]
    checks: JsonObject = {"weathers": {}, "second_vehicle": None, "fitted_sets": None}
    for number, weather in enumerate(others):
        show("other weathers", number, len(others))
        points = {point.name.rpartition(", ")[0]: point for point in system.points}
        matrix = tuple(point._replace(weather=weather, name=name) for name, point in points.items())
        there = replace(system, matrix=matrix, weather=weather)
        try:
            able = settings[are_safe(replace(there, ads=best_driver), settings)]
            checks["weathers"][weather.name] = _counts(are_safe(there, able))
        except UserCodeError:
            continue  # a user's vehicle that knows no wet road
    try:
        show("second vehicle model", 0, 1)
        ours, second = assemble_both_systems(study)
        checks["second_vehicle"] = _counts(are_safe(replace(ours, vehicle=second), settings[:SECOND_VEHICLES]))
    except InputError:
        pass  # the model is not installed, or cannot represent the vehicle
    if study.spread:
        spread = {key: row for key, row in study.spread.items() if key.removeprefix(PREFIX) not in values}
        sets = studies_of_sets(replace_in(study, spread=spread)) if spread else []
        checks["fitted_sets"] = _counts(np.array([are_safe(assemble(one), settings).all() for one in sets]))
    return checks


def _counts(are_safe: BoolArray) -> JsonObject:
    return {"all": len(are_safe), "safe": int(np.count_nonzero(are_safe))}
