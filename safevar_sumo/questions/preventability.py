"""Preventability of collisions (ISO 34502, UN R157): would a reference driver have avoided them in
the same vehicle?

If a competent driver avoids a collision, the driving system failed. If not even full braking at the
first possible moment avoids the collision, the vehicle is the cause. A driver who also collides
with the original vehicle at the same point says nothing about the changed vehicle: no verdict. UN
R157 defines its driver for cars that cut in, cut out or brake on motorways; this module also uses
the driver for pedestrians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.part import at_point
from safevar_sumo.questions.sampling import share_with_interval
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.study import ModelTable
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.system import System

REFERENCE_DRIVERS = "let other drivers drive"
"""The phase of progress in which other drivers drive."""
MAX_SAMPLE = 6_666
"""Maximum number of collisions that other drivers drive. Of more collisions, a random sample is
taken.
"""
LETTER, FULL = "competent_driver", "full_braking"
TITLES = {LETTER: "competent driver", FULL: "full braking"}
"""The reference drivers for all scenarios, the weakest first."""
OF_LANES = ("rss", "fuzzy_safety", "r157")
"""Further drivers, for scenarios in which somebody drives ahead in the lane, or comes into it."""
NOBODY, NO_VERDICT = "nobody", "no verdict"
"""Texts in place of a driver who avoids a collision: no driver avoids it, or this is unknown."""
COLUMNS = shipped_columns("drivers")["drivers"]
"""The columns of the table of drivers. For a sample of the collisions, the interval is that of
Clopper and Pearson, which is slightly too wide, because it does not correct for the finite
population. If all collisions were simulated, both ends are the share itself.
"""


def has_reference_drivers(evaluator: Evaluator) -> bool:
    """Whether reference drivers can drive in place of the driving system. They cannot in a
    simulator of the user that has its own driving system. They do not if only few simulations are
    allowed.
    """
    return (
        evaluator.system.mover.has("a driving system")
        and evaluator.settings_left is None
    )


def assess_sample(
    evaluator: Evaluator, collisions: Evaluations, max_sample: int = MAX_SAMPLE
) -> tuple[pd.DataFrame, int]:
    """The result of `assess_collisions` for different collisions, and the number of different
    collisions (equal settings count once). If there are more than `max_sample`, only a random
    sample is simulated, which depends on the study's seed.
    """
    _, distinct = np.unique(collisions.settings, axis=0, return_index=True)
    shuffled = np.random.default_rng(evaluator.seed).permutation(distinct)
    sample = collisions.take(shuffled[:max_sample])
    return assess_collisions(evaluator, sample), len(distinct)


def drivers_frame(verdicts: pd.DataFrame, collisions: int) -> pd.DataFrame:
    """The frame with a row of `COLUMNS` for each driver; without a row if no collision was
    simulated. `verdicts` and `collisions` are the results of `assess_sample`.
    """
    rows = []
    drivers = []
    if len(verdicts):
        drivers = [*TITLES, *(driver for driver in OF_LANES if driver in verdicts)]
    for driver in drivers:
        of_driver = verdicts[driver]
        number = int(of_driver.count())
        avoided = int(of_driver.sum())
        share, low, high = share_with_interval(avoided, number)
        if len(verdicts) == collisions:
            low = high = share
        points = verdicts["point"][of_driver.isna()].unique()
        counts = (driver, avoided, number - avoided, len(verdicts) - number)
        rows.append((*counts, share, low, high, list(filter(None, points))))
    shares = dict.fromkeys(("share", "share_low", "share_high"), float)
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(shares)


def avoided_by(verdicts: Mapping[Any, Any]) -> str:
    """The name of the weakest driver who avoids a collision; `NOBODY` or `NO_VERDICT` without such
    a driver. `verdicts` is a row of `assess_collisions`.
    """
    otherwise = NO_VERDICT if np.isnan(verdicts[FULL]) else NOBODY
    return next(
        (title for driver, title in TITLES.items() if verdicts[driver] == 1), otherwise
    )


def assess_collisions(evaluator: Evaluator, collisions: Evaluations) -> pd.DataFrame:
    """Whether each driver avoids each of M evaluated collisions at its worst point: 1, 0, or NaN
    for no verdict.

    A driver has no verdict on a collision at a point where he collides with the original vehicle,
    too, or if he cannot be simulated. The columns are the drivers' names and `point`, the name of
    the point.
    """
    system = evaluator.system
    has_lanes = any(point.scenario.border for point in system.points)
    drivers = [*TITLES, *(OF_LANES if has_lanes else ())]
    verdicts = pd.DataFrame(np.nan, range(len(collisions)), drivers).assign(point="")
    for index in np.unique(collisions.points).tolist():
        rows = np.flatnonzero(collisions.points == index)
        point = system.points[index]
        local_evaluator = evaluator
        if system.matrix:
            local_evaluator = evaluator.for_study(at_point(evaluator.study, point.name))
        settings = local_evaluator.characteristics.of_others(
            system.characteristics, collisions.settings[rows]
        )
        verdicts.loc[rows, drivers] = _assess_at_point(
            local_evaluator, settings, drivers
        )
        verdicts.loc[rows, "point"] = point.name
    return verdicts


def _assess_at_point(
    evaluator: Evaluator, settings: FloatArray, drivers: Sequence[str]
) -> FloatArray:
    """The verdicts of all drivers on M collisions at the only point of an evaluator's study, shape
    (M, drivers): 1 if the driver avoids the collision, 0 if not, NaN without a verdict.
    """
    system = evaluator.system.at(evaluator.system.points[0])
    approach = approach_parameters(system)
    verdicts = []
    if approach is None:
        return np.full((len(settings), len(drivers)), np.nan)
    with_original = np.concatenate([system.characteristics.original_settings, settings])
    is_searched = len(system.characteristics.scenario) > 0
    for driver in drivers:
        ads = ModelTable(model=driver, parameters=approach)
        verified = 0 if driver in OF_LANES else None
        with_driver = evaluator.for_study(
            replace(evaluator.study, ads=ads, spread={}), verified=verified
        )
        runs = with_driver.evaluate(with_original, REFERENCE_DRIVERS)
        avoided = np.where(runs.valid, ~runs.collided, np.nan)
        # If encounters are ranges, the evaluator also drives the original vehicle in the setting's
        # encounter. A setting whose original is unsafe there has no valid simulation.
        has_verdict = is_searched or avoided[0] == 1
        verdicts.append(np.where(has_verdict, avoided[1:], np.nan))
    return np.column_stack(verdicts)


def approach_parameters(system: System) -> JsonObject | None:
    """Parameters with which a reference driver approaches as the driving system does with the
    original vehicle.

    From rest, the driver replays the throttle until the driving system first brakes or reaches its
    peak speed, and then holds this speed. So both are at the same position when the danger begins.
    There are no parameters if the run begins at speed, because the driver keeps the speed, or if
    the vehicle never moves. The result is None if encounters are ranges and the run begins at rest:
    each encounter would have an approach of its own.
    """
    trace = drive_worst(system, system.characteristics.original_settings).trace
    speed = trace.speed[:, 0]
    is_braking = trace.brake[:, 0] > 0
    if speed[0] > 0 or not speed.any():
        return {}
    if len(system.characteristics.scenario):
        return None
    end = min(np.argmax(speed), np.argmax([*is_braking, True]))
    return {
        "cruise_speed": float(speed.max()),
        "start_throttle": trace.throttle[:end, 0].tolist(),
    }
