"""Checks of results: user code does not mix settings up, and recorded scenes give the same results as SUMO."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from importlib.metadata import version

import numpy as np
import platformdirs

from safevar_sumo.campaign.evaluation import pack_study
from safevar_sumo.campaign.identity import Inputs, network_digests
from safevar_sumo.campaign.interrupts import wait_for_result
from safevar_sumo.campaign.retrying import RetryingPool
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.output import whole_file
from safevar_sumo.protocol.rater import study_for_sumo_check
from safevar_sumo.records import BoolArray, Evaluations
from safevar_sumo.results import RESULTS
from safevar_sumo.study import Study, tables_of, user_code_names
from safevar_sumo.sumo import Engine, assemble
from safevar_sumo.vehicles import CharacteristicSet

VERIFIED_SETTINGS = 50
"""Number of settings to verify in SUMO: of a study in questions; and of each run of a campaign, besides the solutions.
"""
ROUNDING = 1e-9
"""Largest accepted difference between a metric in a recorded scene and in SUMO."""
EXPECTED_RESULTS = (
    "results of a vehicle that depend on this vehicle alone: nothing kept in a class, a module or the model "
    "itself from one call or "
    "setting to another, no mean or sum over the batch, nothing random"
)
_passed_checks: dict[str, list[str]] = {}
"""Warnings by identity of the studies whose code has passed in this process, in case the cache folder is not writable.
"""


def check_code(study: Study, inputs: Inputs, pool: RetryingPool) -> list[str]:
    """Check the user code of a study in a worker, unless it has passed before with the same files; returns the
    warnings, kept or new.

    Raises
    ------
    UserCodeError
        With file, line and advice of the first finding that makes results wrong.
    """
    if not (user_code_names(study) or any(":" in name for name in study.search.algorithms)):
        return []
    identity = json.dumps([tables_of(study), inputs, RESULTS, version("safevar_sumo")], sort_keys=True, default=str)
    name = hashlib.sha256(identity.encode()).hexdigest()
    marker = platformdirs.user_cache_path("safevar_sumo") / "checks" / name
    with suppress(OSError, ValueError):
        _passed_checks.setdefault(name, json.loads(marker.read_text(encoding="utf-8")))
    if name in _passed_checks:
        return _passed_checks[name]
    original = CharacteristicSet.of(study.vehicle.characteristics).original[np.newaxis]
    remarks = list(
        wait_for_result(
            pool.submit(pack_study(study, inputs, check=True), original, must_succeed=True)
        ).reasons.values()
    )
    _passed_checks[name] = remarks
    with suppress(OSError):  # without the marker, the next process checks again
        marker.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(marker) as file:
            file.write_text(json.dumps(remarks), encoding="utf-8")
    return remarks


def refuse_difference(
    study: Study, run: str, evaluation_in_run: Evaluations, isolated_evaluation: Evaluations, command: str
) -> None:
    """Refuse a setting whose evaluation in a run differs from its isolated evaluation, which `command` reproduces.

    Raises
    ------
    UserCodeError
        With the models, the first result that differs, and the contract.
    """
    difference = find_difference(evaluation_in_run, isolated_evaluation)
    if difference:
        name, value, isolated_value = difference
        problem = (
            f"with {' and '.join(user_code_names(study))} a result depends on what else is simulated: "
            f"{name} is {value} in run {run} and {isolated_value} alone; to reproduce it: {command}"
        )
        raise UserCodeError(f"study {study.name!r}", problem, EXPECTED_RESULTS)


def find_difference(
    evaluations: Evaluations, other_evaluations: Evaluations, tolerance: float = 0.0
) -> tuple[str, object, object] | None:
    """Name and both values of the first quantity that differs by more than `tolerance`; None if all agree or a
    simulation failed.
    """
    if evaluations.failed[0] or other_evaluations.failed[0]:
        return None
    if evaluations.outcome[0] != other_evaluations.outcome[0]:
        return "outcome", str(evaluations.outcome[0]), str(other_evaluations.outcome[0])
    if evaluations.metrics.keys() != other_evaluations.metrics.keys():
        return "the list of metrics", ", ".join(evaluations.metrics), ", ".join(other_evaluations.metrics)
    for name in ("collision_speed", *evaluations.metrics):
        values, other_values = (
            batch.collision_speed if name == "collision_speed" else batch.metrics[name]
            for batch in (evaluations, other_evaluations)
        )
        if not np.allclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True):
            return name, float(values[0]), float(other_values[0])
    return None


def works_for_sumo(study: Study, inputs: Inputs) -> tuple[bytes, bytes]:
    """The packed study with which SUMO verifies results, and a packed study with comparable results from recorded
    scenes.

    SUMO repeats only a few cells of a rating; the second study then has the same cells. Otherwise it is empty.
    """
    sumo_study = study_for_sumo_check(study, assemble(study).weather)
    if sumo_study is study:
        return pack_study(study, inputs, engine=Engine.LIBSUMO), b""
    inputs = {**inputs, "network": network_digests(assemble(sumo_study))}
    return pack_study(sumo_study, inputs, engine=Engine.LIBSUMO), pack_study(sumo_study, inputs)


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO; skip settings that SUMO could not
    simulate.

    Raises
    ------
    InputError
        With the first such setting and both values.
    """
    if in_sumo.failed.all():
        return  # such evaluations lack the user's metrics
    for row in np.flatnonzero(~_are_alike(recorded, in_sumo, ROUNDING) & ~in_sumo.failed).tolist():
        setting = recorded.settings[row]
        difference = find_difference(recorded.take([row]), in_sumo.take([row]), ROUNDING)
        if difference:
            name, value, sumo_value = difference
            values = ", ".join(
                f"{key} = {value:.17g}" for key, value in zip(study.vehicle.characteristics, setting, strict=True)
            )
            raise InputError(
                f"study {study.name!r}",
                f"{name} is {value} in the recorded scene and {sumo_value} in SUMO with {values}",
                "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or `engine=sumo`",
            )


def _are_alike(batch: Evaluations, other_batch: Evaluations, tolerance: float) -> BoolArray:
    """Whether each of N settings has the same outcome, and numbers that differ by at most `tolerance`; shape (N,)."""
    is_alike = batch.outcome == other_batch.outcome
    quantities = (
        (batch.collision_speed, other_batch.collision_speed),
        *((batch.metrics[name], other_batch.metrics[name]) for name in batch.metrics),
    )
    for values, other_values in quantities:
        is_alike &= np.isclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True)
    return np.asarray(is_alike)
