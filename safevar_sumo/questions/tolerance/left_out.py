"""Encounters that do not count, in a study that searches its scenario: how far the original vehicle
itself keeps its margin, and vehicles within limits that touch somebody where it keeps less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS, Judge
from safevar_sumo.questions.models import Model, judges_of
from safevar_sumo.questions.reach import reach
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.by_parameter import Parameter, largest_tried
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import SPEED_DIMENSION
from safevar_sumo.study import ORIGINAL_DEGREE, Study
from safevar_sumo.sumo.matrix import simulate_all_points

STAGE = "encounters that do not count"


class OriginalReach(NamedTuple):
    """The largest values of a parameter up to which the original vehicle keeps its margin in all
    encounters, and up to which it touches nobody; None where it does not even at the least value.
    """

    keeps_up_to: float | None
    safe_up_to: float | None


class Contacts(NamedTuple):
    """Vehicles within limits that touched somebody where the original does not touch but keeps less
    than its margin: their number, and the searched parameter with the lowest value at which one was
    found.
    """

    number: int
    name: str = ""
    lowest: float = np.nan


def _judge_left_out(model: Model, demanded: float) -> Judge:
    """What settings keep [m] in the encounters in which the original vehicle touches nobody, but
    keeps less than `demanded` [m], below 0 on a contact; infinite in all other encounters.
    """

    def robustness(settings: FloatArray) -> FloatArray:
        runs = model.evaluate(settings, STAGE)
        is_between = runs.column(ORIGINAL_DEGREE) < demanded
        counts = is_between & model.evaluator.region.feasible(settings)
        return np.where(counts, model.robustness_by(runs), np.inf)

    return robustness


def leading_parameter(study: Study) -> str:
    """The searched parameter whose lowest unsafe value is said: the speed, or else the first."""
    searched = study.scenario.search
    return SPEED_DIMENSION if SPEED_DIMENSION in searched else next(iter(searched))


def original_reach(evaluator: Evaluator, by: Parameter, unsafe: Unsafe) -> OriginalReach:
    """How far the original vehicle itself keeps what is demanded: of a searched parameter
    `scenario.margin`, over its values up to the largest that is asked; of an axis the criterion's
    distance, at the values that are asked.
    """
    study = evaluator.study
    contact = Unsafe(contact=unsafe.contact)
    if by.name not in study.scenario.search:
        results = simulate_all_points(evaluator.system, evaluator.characteristics.original_settings)
        runs = [(result.point, result.evaluations) for result in results]
        keeps = largest_tried(by, [(point, not unsafe.of(found)[0]) for point, found in runs])
        return OriginalReach(
            keeps, largest_tried(by, [(point, not found.collided[0]) for point, found in runs])
        )
    members = evaluator.characteristics
    column = members.names.index(by.name)
    lower = np.where(members.of_vehicle, members.original, members.lower)
    upper = np.where(members.of_vehicle, members.original, members.upper)
    upper[column] = by.values[-1]
    box = Box(evaluator.region, lower, upper)
    # At points that are selected all encounters count, also those in which the original is not
    # safe.
    every_point = tuple(range(len(evaluator.system.points)))
    reaches = list[float | None]()
    for demanded in (study.scenario.margin, 0.0):
        original = Model(0, evaluator, replace(contact, keep=demanded), every_point)
        judges = judges_of([original], STAGE)
        stream = study.search.seed, Stream.ORIGINAL_UP_TO
        start = float(lower[column])
        reaches.append(reach(box, (1, column), start, judges, LEAST_SIMULATIONS, stream).value)
    return OriginalReach(*reaches)


def contacts_left_out(models: Sequence[Model], boxes: Sequence[Box], name: str = "") -> Contacts:
    """Search boxes of vehicles for contacts in encounters that do not count, and for the lowest
    value of a searched parameter with one: by default of the speed, or else of the first that is
    searched.
    """
    evaluator = models[0].evaluator
    study = evaluator.study
    name = name or leading_parameter(study)
    column = evaluator.characteristics.names.index(name)
    judges = list[Judge]()
    for model in models:
        own = model.evaluator.study
        nearer = replace_in(own, scenario=replace_in(own.scenario, margin=0.0))
        unsafe = Unsafe(contact=model.unsafe.contact)
        demanded = study.scenario.margin + model.unsafe.contact
        in_all = Model(model.fit, model.evaluator.for_study(nearer, verified=0), unsafe)
        judges.append(_judge_left_out(in_all, demanded))
    found = list[FloatArray]()
    for number, box in enumerate(boxes):
        stream = study.search.seed, Stream.LEFT_OUT, number
        start = float(box.lower[column])
        failures = reach(box, (1, column), start, judges, LEAST_SIMULATIONS, stream).failures
        found += [rows for _, rows in failures]
    if not found:
        return Contacts(0)
    distinct = np.unique(np.concatenate(found), axis=0)
    return Contacts(len(distinct), name, float(distinct[:, column].min()))
