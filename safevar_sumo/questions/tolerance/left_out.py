"""Encounters that do not count, in a study that searches its scenario: how far the original vehicle
itself keeps its margin, and vehicles within limits that touch somebody where it keeps less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS, reach
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.by_parameter import Parameter, largest_tried
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios import SPEED_DIMENSION
from safevar_sumo.study import ORIGINAL_DEGREE, Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble

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


@dataclass(frozen=True)
class _LeftOut:
    """A model in the encounters in which the original vehicle touches nobody, but keeps less than
    `demanded` [m].
    """

    model: Model
    demanded: float

    def left(self, settings: FloatArray, stage: str) -> FloatArray:
        """What settings keep [m], below 0 on a contact, shape (M,); infinite in all other
        encounters.
        """
        runs = self.model.evaluate(settings, stage)
        is_between = runs.column(ORIGINAL_DEGREE) < self.demanded
        counts = is_between & self.model.evaluator.region.feasible(settings)
        return np.where(counts, self.model.left_by(runs), np.inf)

    def are_unsafe(self, settings: FloatArray, stage: str) -> BoolArray:
        """Which settings touch somebody, shape (M,)."""
        return self.left(settings, stage) < 0


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
        results = simulate_all_points(
            assemble(study), evaluator.characteristics.original[np.newaxis]
        )
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
    every_point = tuple(range(len(assemble(study).points)))
    reaches = list[float | None]()
    for demanded in (study.scenario.margin, 0.0):
        original = Model(0, evaluator, replace(contact, keep=demanded), every_point)
        stream = study.search.seed, Stream.ORIGINAL_UP_TO
        reaches.append(reach(box, column, [original], LEAST_SIMULATIONS, stream, STAGE).value)
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
    left_out = list[_LeftOut]()
    for model in models:
        own = model.evaluator.study
        nearer = replace_in(own, scenario=replace_in(own.scenario, margin=0.0))
        unsafe = Unsafe(contact=model.unsafe.contact)
        demanded = study.scenario.margin + model.unsafe.contact
        left_out.append(
            _LeftOut(
                Model(model.fit, model.evaluator.for_study(nearer, verified=0), unsafe), demanded
            )
        )
    found = list[FloatArray]()
    for number, box in enumerate(boxes):
        stream = study.search.seed, Stream.LEFT_OUT, number
        failures = reach(box, column, left_out, LEAST_SIMULATIONS, stream, STAGE).failures
        found += [rows for _, rows in failures]
    if not found:
        return Contacts(0)
    distinct = np.unique(np.concatenate(found), axis=0)
    return Contacts(len(distinct), name, float(distinct[:, column].min()))
