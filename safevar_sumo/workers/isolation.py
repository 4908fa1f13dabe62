"""Checks that code from outside keeps settings apart, and that recorded scenes give the same results as SUMO."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from importlib.metadata import version

import numpy as np
import platformdirs

from safevar_sumo.errors import ForeignError, InputError
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
"""Largest difference between a metric in a recorded scene and in SUMO."""
_passed: set[str] = set()
"""Identities of studies and their code that have passed in this process, should the cache not be writable."""


def check_code(study: Study, inputs: Inputs, pool: RetryingPool) -> list[str]:
    """Check the code from outside that a study names, in a worker; code that has passed with the same files is not checked again.

    Returns remarks that do not make results wrong.

    Raises
    ------
    ForeignError
        Naming the first finding that makes results wrong, with file, line and advice.
    """
    if not (foreign_names(study) or any(":" in name for name in study.search.algorithms)):
        return []
    identity = json.dumps([tables_of(study), inputs, RESULTS, version("safevar_sumo")], sort_keys=True, default=str)
    name = hashlib.sha256(identity.encode()).hexdigest()
    passed = platformdirs.user_cache_path("safevar_sumo") / "checks" / name
    if name in _passed or passed.exists():
        return []
    original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
    remarks = list(awaited(pool.submit(packed(study, inputs, check=True), original, must_succeed=True)).reasons.values())
    _passed.add(name)
    with suppress(OSError):  # it is checked again then
        passed.parent.mkdir(parents=True, exist_ok=True)
        passed.touch()
    return remarks


def refuse_difference(study: Study, ways: dict[str, Evaluations], again: str = "") -> None:
    """Refuse evaluations of a setting, by the way in which it was simulated, that differ; the command `again` repeats one of them.

    Raises
    ------
    ForeignError
        Naming the models, the first result that differs, and what to do.
    """
    (first_way, first), (other_way, other) = next(iter(ways.items())), list(ways.items())[-1]
    difference = _difference(first, other)
    if difference:
        name, value, other_value = difference
        problem = (f"with {' and '.join(foreign_names(study))} a result depends on what else is simulated: "
                   f"{name} is {value} {first_way} and {other_value} {other_way}")
        raise ForeignError(f"study {study.name!r}", f"{problem}{again and f'; again by: {again}'}", LEGAL)


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO itself; settings that SUMO could not simulate are skipped.

    Raises
    ------
    InputError
        With the setting and both values.
    """
    for row in np.flatnonzero(~_alike(recorded, in_sumo, ROUNDING) & ~in_sumo.failed).tolist():
        setting = recorded.settings[row]
        difference = _difference(recorded.take([row]), in_sumo.take([row]), ROUNDING)
        if difference:
            name, value, sumo_value = difference
            values = ", ".join(f"{key} = {value:.17g}" for key, value in zip(study.vehicle.characteristics, setting, strict=True))
            raise InputError(f"study {study.name!r}", f"{name} is {value} in the recorded scene and {sumo_value} in SUMO with {values}",
                             "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or --engine sumo")


def _alike(one: Evaluations, other: Evaluations, tolerance: float) -> BoolArray:
    """Whether settings have the same outcome and numbers that differ by at most `tolerance`, shape (N,)."""
    alike = one.outcome == other.outcome
    quantities = ((one.collision_speed, other.collision_speed), *((one.metrics[name], other.metrics[name]) for name in one.metrics))
    for values, other_values in quantities:
        alike &= np.isclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True)
    return np.asarray(alike)


def _difference(one: Evaluations, other: Evaluations, tolerance: float = 0.0) -> tuple[str, object, object] | None:
    """The first quantity that differs by more than `tolerance` in two evaluations of a setting, and both values; None if one failed."""
    if one.failed[0] or other.failed[0]:
        return None
    if one.outcome[0] != other.outcome[0]:
        return "outcome", str(one.outcome[0]), str(other.outcome[0])
    for name in ("collision_speed", *one.metrics):
        values, other_values = (evaluation.metrics.get(name, evaluation.collision_speed) for evaluation in (one, other))
        if not np.allclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True):
            return name, float(values[0]), float(other_values[0])
    return None
