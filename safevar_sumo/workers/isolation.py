"""Checks that models from outside keep settings apart, and that a recorded scene gives the results of SUMO."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from typing import Protocol

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import ForeignError, InputError
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.study import Study, foreign_names
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.local import result_of

LEGAL = ("what happens to vehicle i depends on vehicle i alone: nothing kept in a class, a module or the model itself from one call or "
         "setting to another, no mean or sum over the batch, nothing random")

ROUNDING = 1e-9
"""Largest difference between a metric in a recorded scene and in SUMO."""


class Submit(Protocol):
    """Computes a batch of settings."""

    def __call__(self, settings: FloatArray) -> Future[Evaluations]: ...


def check_isolation(study: Study, characteristics: CharacteristicSet, submit: Submit) -> None:
    """Simulate the same settings together, again, in another order and alone; refuse models whose results differ.

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
    results = {way: {int(row): result_of(future).take([i]) for rows, future in batches for i, row in enumerate(rows)}
               for way, batches in running.items()}
    for way, by_row in results.items():
        for row, result in by_row.items():
            refuse_difference(study, {"together": results["together"][row], way: result})


def refuse_difference(study: Study, ways: dict[str, Evaluations], again: str = "") -> None:
    """Refuse two different evaluations of a setting, by how it was simulated; `again` is a command that repeats one of them.

    Raises
    ------
    ForeignError
        As `check_isolation`.
    """
    (here, first), (there, second) = next(iter(ways.items())), list(ways.items())[-1]
    difference = _difference(first, second)
    if difference:
        name, value, other_value = difference
        problem = (f"with {' and '.join(foreign_names(study))} a result depends on what else is simulated: "
                   f"{name} is {value} {here} and {other_value} {there}")
        raise ForeignError(f"study {study.name!r}", f"{problem}{again and f'; again by: {again}'}", LEGAL)


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO itself; what SUMO could not simulate tells nothing.

    Raises
    ------
    InputError
        With the setting and both values.
    """
    for row in np.flatnonzero(~_alike(recorded, in_sumo, ROUNDING) & ~in_sumo.failed).tolist():
        setting = recorded.settings[row]
        one, other = recorded.take([row]), in_sumo.take([row])
        difference = _difference(one, other, ROUNDING)
        if difference:
            name, here, there = difference
            values = ", ".join(f"{key} = {value:.17g}" for key, value in zip(study.vehicle.characteristics, setting, strict=True))
            raise InputError(f"study {study.name!r}", f"{name} is {here} in the recorded scene and {there} in SUMO with {values}",
                             "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or --engine sumo")


def _alike(one: Evaluations, other: Evaluations, most: float) -> BoolArray:
    """Settings whose outcome is the same and whose numbers differ by no more than `most`, shape (N,)."""
    alike = one.outcome == other.outcome
    for here, there in ((one.collision_speed, other.collision_speed), *((one.metrics[name], other.metrics[name]) for name in one.metrics)):
        alike &= np.isclose(here, there, rtol=0, atol=most, equal_nan=True)
    return np.asarray(alike)


def _far_apart(characteristics: CharacteristicSet) -> FloatArray:
    """The original setting and corners of the domains, filtered; shape (5, n)."""
    lower, upper, number = characteristics.lower, characteristics.upper, np.arange(len(characteristics))
    corners = [characteristics.original, lower, upper, np.where(number % 2, lower, upper), np.where(number % 2, upper, lower)]
    return characteristics.filter(np.array(corners))


def _difference(one: Evaluations, other: Evaluations, tolerance: float = 0.0) -> tuple[str, object, object] | None:
    """The first quantity that differs by more than `tolerance` in two evaluations of a setting, and both values; None if one failed."""
    if one.failed[0] or other.failed[0]:
        return None
    if one.outcome[0] != other.outcome[0]:
        return "outcome", str(one.outcome[0]), str(other.outcome[0])
    for name in ("collision_speed", *one.metrics):
        here, there = (evaluation.metrics.get(name, evaluation.collision_speed) for evaluation in (one, other))
        if not np.allclose(here, there, rtol=0, atol=tolerance, equal_nan=True):
            return name, float(here[0]), float(there[0])
    return None
