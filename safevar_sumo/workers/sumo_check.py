"""Checks that recorded scenes give the same results as SUMO."""

from __future__ import annotations

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import BoolArray, Evaluations
from safevar_sumo.study import Study
from safevar_sumo.workers.isolation import find_difference

ROUNDING = 1e-9
"""Largest accepted difference between a metric in a recorded scene and in SUMO."""


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO; skip settings that SUMO could not simulate.

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
            values = ", ".join(f"{key} = {value:.17g}" for key, value in zip(study.vehicle.characteristics, setting, strict=True))
            raise InputError(f"study {study.name!r}", f"{name} is {value} in the recorded scene and {sumo_value} in SUMO with {values}",
                             "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or `engine=sumo`")


def _are_alike(batch: Evaluations, other_batch: Evaluations, tolerance: float) -> BoolArray:
    """Whether each of N settings has the same outcome, and numbers that differ by at most `tolerance`; shape (N,)."""
    is_alike = batch.outcome == other_batch.outcome
    quantities = ((batch.collision_speed, other_batch.collision_speed),
                  *((batch.metrics[name], other_batch.metrics[name]) for name in batch.metrics))
    for values, other_values in quantities:
        is_alike &= np.isclose(values, other_values, rtol=0, atol=tolerance, equal_nan=True)
    return np.asarray(is_alike)
