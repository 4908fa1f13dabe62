"""Encounters that wear has cost: those that a competent driver avoids in the new car, and no longer in the worn one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.causes import Cause
from safevar_sumo.questions.preventability import ANY, LETTER
from safevar_sumo.questions.tables import Column, Columns
from safevar_sumo.records import FloatArray, Outcome
from safevar_sumo.scenarios import WEATHER_PARAMETERS, Point
from safevar_sumo.study import Domain, ModelTable, Study, free_parameters
from safevar_sumo.sumo.system import assemble

BORDERS = "borders of what a competent driver avoids"
"""The stage of progress."""
STEPS, ROUNDS = 12, 3
"""Number of values between which a border is sought; and how often, from the second time on between two neighbours."""
COLUMNS: Columns = {
    "characteristic": "characteristic that is changed alone",
    "value": Column("", "its value, the furthest from the original in the causes", ".5g"),
    "scenario": "scenario, and the parameter that has the border",
    "border_before": Column("", "value from which on a competent driver avoids the collision in the new car", ".4g"),
    "border_now": Column("", "the same in the car with this change", ".4g"),
}


def find_moved_borders(evaluator: Evaluator, causes: Iterable[Cause]) -> pd.DataFrame:
    """A row of `COLUMNS` for each characteristic of the causes and each scenario with a border that it moves.

    The driver reacts to any braking of a leader.
    """
    system, original = assemble(evaluator.study), evaluator.characteristics.original
    names, furthest = list(evaluator.characteristics.names), original.copy()
    for name, value in (pair for cause in causes for pair in cause.changes.items()):
        k = names.index(name)
        if abs(value - original[k]) > abs(furthest[k] - original[k]):
            furthest[k] = value
    changed = np.flatnonzero(furthest != original).tolist()
    rows = []
    for point in system.points if changed else ():
        border = point.scenario.border
        domain = free_parameters(type(point.scenario)).get(border)
        if domain is None:
            continue
        searched = Domain(unit=domain.unit, original=domain.upper, lower=domain.lower, upper=domain.upper)
        study = _with_border(evaluator.study, point, border, searched)
        with_driver = evaluator.for_study(study, verified=0)
        vehicle = original[evaluator.characteristics.of_vehicle]
        cars = np.where(np.eye(len(vehicle), dtype=bool), furthest[: len(vehicle)], vehicle)[changed]
        before, *borders = _borders(with_driver, np.vstack([vehicle, cars]), searched).tolist()
        title = f"{point.name or evaluator.study.scenario.model}: {border} [{domain.unit}]"
        moved = [pair for pair in zip(changed, borders, strict=True) if pair[1] > before]
        rows += [(names[k], furthest[k], title, before, now) for k, now in moved]
    return pd.DataFrame(rows, columns=[*COLUMNS])


def _with_border(study: Study, point: Point, border: str, domain: Domain) -> Study:
    """The study at one of its points, with a competent driver, and this parameter of the scenario alone searched."""
    parameters = {**study.scenario.parameters, **{name: one.original for name, one in study.scenario.search.items()}}
    model, over = study.scenario.model, dict(point.parameters)
    if study.matrix is not None and study.matrix.tests:
        test = next(test for test in study.matrix.tests if test.name == over["test"])
        shared = parameters if test.model in ("", model) else {}
        parameters = {**shared, **test.parameters, **{key: over[key] for key in test.over}}
        model = test.model or model
    fixed = {name: value for name, value in parameters.items() if name not in (border, *WEATHER_PARAMETERS)}
    scenario = replace(study.scenario, model=model, parameters=fixed, search={border: domain}, margin=0.0)
    driver = ModelTable(model=LETTER, parameters=ANY)
    return replace(study, scenario=scenario, matrix=None, weather=point.weather, ads=driver, spread={})


def _borders(evaluator: Evaluator, cars: FloatArray, domain: Domain) -> FloatArray:
    """The values from which on each of M cars, shape (M, n), is safe, and the first one, the new car, too; shape (M,).
    A border beyond the domain is its end.
    """
    rows = np.arange(len(cars))
    low, high = np.full(len(cars), domain.lower), np.full(len(cars), domain.upper)
    for _ in range(ROUNDS):
        values = low[:, np.newaxis] + (high - low)[:, np.newaxis] * np.linspace(0.0, 1.0, STEPS)
        settings = np.column_stack([np.repeat(cars, STEPS, axis=0), values.ravel()])
        runs = evaluator.evaluate(settings, BORDERS, ignore_constraints=True)
        # Where the new car is unsafe, the encounter is infeasible.
        fails = (runs.collided | (runs.outcome == Outcome.INFEASIBLE)).reshape(values.shape)
        ever_fails = fails.any(axis=1)
        last = np.where(ever_fails, STEPS - 1 - np.argmax(fails[:, ::-1], axis=1), 0)
        low, high = values[rows, last], values[rows, np.minimum(last + ever_fails, STEPS - 1)]
    return np.asarray(high)
