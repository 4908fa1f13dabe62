"""Checks that code from outside does not mix settings up, and that recorded scenes give the same results as SUMO."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from importlib.metadata import version

import numpy as np
import platformdirs

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.records import BoolArray, Evaluations
from safevar_sumo.results import RESULTS
from safevar_sumo.study import Study, foreign_names, tables_of
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import packed
from safevar_sumo.workers.identity import Inputs
from safevar_sumo.workers.interrupts import awaited
from safevar_sumo.workers.retrying import RetryingPool

LEGAL = ("results of a vehicle that depend on this vehicle alone: nothing kept in a class, a module or the model itself from one call or "
         "setting to another, no mean or sum over the batch, nothing random")

ROUNDING = 1e-9
"""Largest accepted difference between a metric in a recorded scene and in SUMO."""
_passed_checks: set[str] = set()
"""Identities of studies whose code has passed in this process, in case the cache folder is not writable."""


def check_code(study: Study, inputs: Inputs, pool: RetryingPool) -> list[str]:
    """Check the code from outside of a study in a worker, unless it has passed before with the same files.

    Returns warnings.

    Raises
    ------
    UserCodeError
        With file, line and advice of the first finding that makes results wrong.
    """
    if not (foreign_names(study) or any(":" in name for name in study.search.algorithms)):
        return []
    identity = json.dumps([tables_of(study), inputs, RESULTS, version("safevar_sumo")], sort_keys=True, default=str)
    name = hashlib.sha256(identity.encode()).hexdigest()
    marker = platformdirs.user_cache_path("safevar_sumo") / "checks" / name
    if name in _passed_checks or marker.exists():
        return []
    original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
    remarks = list(awaited(pool.submit(packed(study, inputs, check=True), original, must_succeed=True)).reasons.values())
    _passed_checks.add(name)
    with suppress(OSError):  # without the marker, the next process checks again
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
    return remarks


def refuse_difference(study: Study, ways: dict[str, Evaluations], again: str = "") -> None:
    """Refuse differing evaluations of one setting, given by the way of simulation; the command `again` repeats one of them.

    Raises
    ------
    UserCodeError
        With the models, the first result that differs, and the contract.
    """
    (first_way, evaluation), (other_way, other_evaluation) = next(iter(ways.items())), list(ways.items())[-1]
    difference = _difference(evaluation, other_evaluation)
    if difference:
        name, value, other_value = difference
        problem = (f"with {' and '.join(foreign_names(study))} a result depends on what else is simulated: "
                   f"{name} is {value} {first_way} and {other_value} {other_way}")
        raise UserCodeError(f"study {study.name!r}", f"{problem}{again and f'; again by: {again}'}", LEGAL)


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO; skip settings that SUMO could not simulate.

    Raises
    ------
    InputError
        With the first such setting and both values.
    """
    for row in np.flatnonzero(~_is_alike(recorded, in_sumo, ROUNDING) & ~in_sumo.failed).tolist():
        setting = recorded.settings[row]
        difference = _difference(recorded.take([row]), in_sumo.take([row]), ROUNDING)
        if difference:
            name, value, sumo_value = difference
            values = ", ".join(f"{key} = {value:.17g}" for key, value in zip(study.vehicle.characteristics, setting, strict=True))
            raise InputError(f"study {study.name!r}", f"{name} is {value} in the recorded scene and {sumo_value} in SUMO with {values}",
                             "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or --engine sumo")


def _is_alike(batch: Evaluations, other_batch: Evaluations, tolerance: float) -> BoolArray:
    """Whether each of N settings has the same outcome, and numbers that differ by at most `tolerance`; shape (N,)."""
    is_alike = batch.outcome == other_batch.outcome
    quantities = ((batch.collision_speed, other_batch.collision_speed),
                  *((batch.metrics[name], other_batch.metrics[name]) for name in batch.metrics))
    for values, other_values in quantities:
        is_alike &= np.isclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True)
    return np.asarray(is_alike)


def _difference(evaluations: Evaluations, other_evaluations: Evaluations, tolerance: float = 0.0) -> tuple[str, object, object] | None:
    """Name and both values of the first quantity that differs by more than `tolerance`; None if a simulation failed."""
    if evaluations.failed[0] or other_evaluations.failed[0]:
        return None
    if evaluations.outcome[0] != other_evaluations.outcome[0]:
        return "outcome", str(evaluations.outcome[0]), str(other_evaluations.outcome[0])
    for name in ("collision_speed", *evaluations.metrics):
        values, other_values = (side.metrics.get(name, side.collision_speed) for side in (evaluations, other_evaluations))
        if not np.allclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True):
            return name, float(values[0]), float(other_values[0])
    return None
