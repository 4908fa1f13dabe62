"""Whether other people's models keep settings apart: the same settings alone, together, again and in another order."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from typing import Protocol

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import ForeignError, InputError
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, foreign_names
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.local import result_of

LEGAL = ("what happens to vehicle i depends on vehicle i alone: nothing kept in a class, a module or the model itself from one call or "
         "setting to another, no mean or sum over the batch, nothing random")

ROUNDING = 1e-9
"""Most by which a metric in a recorded scene may differ from SUMO's."""


class Submit(Protocol):
    """Has a batch of settings computed."""

    def __call__(self, settings: FloatArray) -> Future[Evaluations]: ...


def check_isolation(study: Study, characteristics: CharacteristicSet, submit: Submit) -> None:
    """Refuse models that let one setting change another's result.

    Raises
    ------
    ForeignError
        Naming the models, the first result that differs, and what to do.
    """
    if not foreign_names(study):
        return
    settings = _far_apart(characteristics)
    order = np.arange(len(settings))
    ways: dict[str, Sequence[npt.NDArray[np.intp]]] = {
        "together": [order], "together again": [order], "in another order": [order[::-1]], "alone": list(order[:, np.newaxis])}
    running = {way: [(rows, submit(settings[rows])) for rows in batches] for way, batches in ways.items()}
    found = {way: {int(row): result_of(future).take([i]) for rows, future in batches for i, row in enumerate(rows)}
             for way, batches in running.items()}
    for way, results in found.items():
        for row, result in results.items():
            refuse_difference(study, {"together": found["together"][row], way: result})


def refuse_difference(study: Study, ways: dict[str, Evaluations], again: str = "") -> None:
    """Refuse two evaluations of one setting that differ, by how they came about; `again` is a command that has one of them again.

    Raises
    ------
    ForeignError
        As `check_isolation`.
    """
    (here, one), (there, other) = next(iter(ways.items())), list(ways.items())[-1]
    told = _difference(one, other)
    if told:
        name, value, others = told
        problem = (f"with {' and '.join(foreign_names(study))} a result depends on what else is simulated: "
                   f"{name} is {value} {here} and {others} {there}")
        raise ForeignError(f"study {study.name!r}", f"{problem}{again and f'; again by: {again}'}", LEGAL)


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings that came out otherwise in a recorded scene than in SUMO itself.

    Raises
    ------
    InputError
        With the setting and both values.
    """
    for row, setting in enumerate(recorded.settings):
        one, other = recorded.take([row]), in_sumo.take([row])
        if other.failed[0]:
            difference: tuple[str, object, object] | None = ("outcome", str(one.outcome[0]), f"{other.outcome[0]} ({other.reason(0)})")
        else:
            difference = _difference(one, other, ROUNDING)
        if difference:
            name, here, there = difference
            values = ", ".join(f"{key} = {value:.17g}" for key, value in zip(study.vehicle.characteristics, setting, strict=True))
            raise InputError(f"study {study.name!r}", f"{name} is {here} in the recorded scene and {there} in SUMO with {values}",
                             "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or --engine sumo")


def _far_apart(characteristics: CharacteristicSet) -> FloatArray:
    """The original setting and corners of the domains, filtered; shape (5, n)."""
    lower, upper, number = characteristics.lower, characteristics.upper, np.arange(len(characteristics))
    corners = [characteristics.original, lower, upper, np.where(number % 2, lower, upper), np.where(number % 2, upper, lower)]
    return characteristics.filter(np.array(corners))


def _difference(one: Evaluations, other: Evaluations, most: float = 0.0) -> tuple[str, object, object] | None:
    """The first number in which two evaluations of a setting differ, and both values, by more than `most`; failures tell nothing."""
    if one.failed[0] or other.failed[0]:
        return None
    if one.outcome[0] != other.outcome[0]:
        return "outcome", str(one.outcome[0]), str(other.outcome[0])
    for name in ("collision_speed", *one.metrics):
        here, there = (of.metrics.get(name, of.collision_speed) for of in (one, other))
        if not np.allclose(here, there, rtol=0, atol=most, equal_nan=True):
            return name, float(here[0]), float(there[0])
    return None
