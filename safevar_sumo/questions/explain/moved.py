"""Encounters that wear has cost: those that a competent driver avoids in the original vehicle, and
no longer in the worn one.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.causes import Cause
from safevar_sumo.questions.preventability import ANY, LETTER
from safevar_sumo.questions.tables import Column, Columns
from safevar_sumo.records import BoolArray, FloatArray, Outcome
from safevar_sumo.scenarios import WEATHER_PARAMETERS, Point
from safevar_sumo.study import Domain, ModelTable, Study

BORDERS = "borders of what a competent driver avoids"
"""The phase of progress."""
STEPS, REFINING = 12, (12, 12)
"""Number of values between which a border is sought; and of parts into which each round divides
what is between two neighbours.
"""
COLUMNS: Columns = {
    "characteristic": "characteristic that is changed alone",
    "value": Column("", "its value, the furthest from the original in the causes", ".5g"),
    "scenario": "scenario, and the parameter that has the border",
    "border_before": Column(
        "",
        "value from which on, up to the study's own, a competent driver avoids the collision in the"
        " original vehicle",
        ".4g",
    ),
    "border_now": Column(
        "",
        "the same in the vehicle with this change, which may be above the study's value; undefined"
        " if at no value",
        ".4g",
    ),
}


def find_moved_borders(evaluator: Evaluator, causes: Iterable[Cause]) -> pd.DataFrame:
    """A row of `COLUMNS` for each characteristic of the causes and each scenario with a border that
    it moves.

    The driver reacts to any braking of a leader.
    """
    # The furthest value of each characteristic in the causes.
    system = evaluator.system
    original = evaluator.characteristics.original
    names = list(evaluator.characteristics.names)
    furthest = original.copy()
    for name, value in (pair for cause in causes for pair in cause.changes.items()):
        k = names.index(name)
        if abs(value - original[k]) > abs(furthest[k] - original[k]):
            furthest[k] = value
    changed = np.flatnonzero(furthest != original).tolist()

    # The border of the encounter that moves, at every point.
    rows = []
    for point in system.points if changed else ():
        border = point.scenario.border
        free = point.scenario.free().get(border)
        if free is None:
            continue
        own = getattr(point.scenario, border, None)
        own = free.upper if own is None else min(max(own, free.lower), free.upper)
        widest = Domain(unit=free.unit, original=own, lower=free.lower, upper=free.upper)
        domain = evaluator.study.scenario.search.get(border, widest)
        study = _with_border(evaluator.study, point, border, domain)
        with_driver = evaluator.for_study(study, verified=0)

        # The original vehicle, and vehicles with one change each.
        vehicle = original[evaluator.characteristics.of_vehicle]
        vehicles = np.where(np.eye(len(vehicle), dtype=bool), furthest[: len(vehicle)], vehicle)[
            changed
        ]
        before, *borders = _borders(with_driver, np.vstack([vehicle, vehicles]), domain).tolist()
        title = f"{point.name or evaluator.study.scenario.model}: {border} [{domain.unit}]"
        moved = [pair for pair in zip(changed, borders, strict=True) if pair[1] > before]
        rows += [
            (names[k], furthest[k], title, before, now if now < np.inf else None)
            for k, now in moved
        ]
    return pd.DataFrame(rows, columns=[*COLUMNS])


def _with_border(study: Study, point: Point, border: str, domain: Domain) -> Study:
    """The study at one of its points, with a competent driver, and this parameter of the scenario
    alone searched.
    """
    # The study's parameters at this point.
    parameters = {
        **study.scenario.parameters,
        **{name: domain.original for name, domain in study.scenario.search.items()},
    }
    model = study.scenario.model
    over = dict(point.parameters)
    if study.matrix is not None and study.matrix.tests:
        test = next(test for test in study.matrix.tests if test.name == over["test"])
        shared = parameters if test.model in ("", model) else {}
        parameters = {**shared, **test.parameters, **{key: over[key] for key in test.over}}
        model = test.model or model

    # All are fixed but the border.
    fixed = {
        name: value
        for name, value in parameters.items()
        if name not in (border, *WEATHER_PARAMETERS)
    }
    scenario = replace(
        study.scenario, model=model, parameters=fixed, search={border: domain}, margin=0.0
    )
    driver = ModelTable(model=LETTER, parameters=ANY)
    return replace(
        study,
        scenario=scenario,
        matrix=None,
        weather=point.weather,
        ads=driver,
        spread={},
        constraints=[],
    )


def _borders(evaluator: Evaluator, vehicles: FloatArray, domain: Domain) -> FloatArray:
    """The values from which on each of M vehicles, shape (M, n), is safe, up to the study's own
    value or, if it is unsafe there, up to the first safe value above; shape (M,). The first vehicle
    is the original one.

    It is the domain's lower end if a vehicle is safe from there on, and infinite if no value from
    the study's own on is.
    """
    values = np.sort([*np.linspace(domain.lower, domain.upper, STEPS), domain.original])

    def are_unsafe(settings: FloatArray) -> BoolArray:
        """Which settings collide, or are in an encounter that is infeasible, as the original
        vehicle collides.
        """
        runs = evaluator.evaluate(settings, BORDERS, ignore_constraints=True)
        return np.asarray(runs.collided | (runs.outcome == Outcome.INFEASIBLE))

    # Every vehicle at the same values, which cover the domain.
    grid = np.column_stack(
        [np.repeat(vehicles, len(values), axis=0), np.tile(values, len(vehicles))]
    )
    fails = are_unsafe(grid).reshape(len(vehicles), len(values))
    # A border is below the first safe value from the study's own on.
    own = int(np.searchsorted(values, domain.original))
    is_never_safe = fails[:, own:].all(axis=1)
    first_safe = own + np.argmin(fails[:, own:], axis=1)
    fails &= np.arange(len(values)) < first_safe[:, np.newaxis]
    borders = np.where(is_never_safe, np.inf, domain.lower)
    # It lies between the last unsafe value below that one and its neighbour.
    rows = np.flatnonzero(fails.any(axis=1) & ~is_never_safe)
    last = len(values) - 1 - np.argmax(fails[rows, ::-1], axis=1)
    starts = np.column_stack([vehicles[rows], values[last + 1]])
    ends = np.column_stack([vehicles[rows], values[last]])
    if len(rows):
        borders[rows] = find_boundaries(starts, ends, are_unsafe, REFINING).safe[:, -1]
    return borders
