"""Preventability of collisions (ISO 34502, UN R157): would a reference driver have avoided them in
the same vehicle?

If a competent driver avoids a collision, the driving system failed. If not even full braking at the
first possible moment avoids it, the vehicle is the cause. A driver who collides at a point in the
original vehicle, too, says nothing about a changed vehicle there: no verdict. UN R157 means its
driver for cars that cut in, cut out or brake on motorways; its use for pedestrians is ours. How
fast a driver reacts to a pedestrian is therefore uncertain: the share of collisions that the driver
avoids is computed for a later reaction, too. The regulation names no danger if a leader brakes with
5 m/s^2 or less: there are two conventions, and both are computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.ads.reaction import ANY_BRAKING
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.part import at_point
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.tables import Column, Columns, with_interval
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.scenarios import PreCrash
from safevar_sumo.study import ModelTable
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.system import System

REFERENCE_DRIVERS = "reference drivers in the same vehicle"
"""The stage of progress."""
MAX_SIMULATIONS = 20_000
"""Approximate maximum number of simulations; if all given collisions need more, a random sample of
them is simulated.
"""
DELAY = 0.4
"""Time by which a competent driver reacts later in the second of two computations [s]."""
LATER = {"reaction_time": CompetentDriver().reaction_time + DELAY}
ANY = {"leader_braking": ANY_BRAKING}
LETTER, ANY_LEADER, FULL = "competent_driver", "competent_driver_any_braking", "full_braking"
DRIVERS: dict[str, tuple[str, JsonObject]] = {
    LETTER: ("competent_driver", {}),
    ANY_LEADER: ("competent_driver", ANY),
    FULL: ("full_braking", {}),
    f"{LETTER}_later": ("competent_driver", LATER),
    f"{ANY_LEADER}_later": ("competent_driver", ANY | LATER),
}
"""Model and parameters of each driver, the weakest first; those who react later are not counted as
drivers.
"""
OF_LANES: dict[str, tuple[str, JsonObject]] = {
    name: (name, {}) for name in ("rss", "fuzzy_safety", "r157")
}
"""Further drivers where somebody drives ahead in the lane, or comes into it."""
TITLES = {
    LETTER: "competent driver",
    ANY_LEADER: "competent driver, any braking of a leader",
    FULL: "full braking",
}
NOBODY, NO_VERDICT = "nobody", "no verdict"
"""In the place of a driver who avoids a collision."""
COLUMNS: Columns = {
    "driver": (
        "reference driver in the same vehicle: a competent driver; one who reacts to any braking of"
        " a leader, not only above 5 m/s^2; full braking at the first possible moment; where a car"
        " ahead brakes, or takes or leaves the lane, rss (responsibility-sensitive safety),"
        " fuzzy_safety and r157 (UN R157, 5.2.5)"
    ),
    "avoided": "collisions that he avoids",
    "later": f"collisions that he avoids if he needs {DELAY:g} s longer",
    "no_longer": "collisions that he avoids in the original vehicle, but not in this one",
    "no_verdict": "collisions at points where he collides in the original vehicle, too: no verdict",
    **with_interval("share", Column("-", "share that he avoids of those with a verdict", ".2f")),
    "later_share": Column("-", f"the share if he needs {DELAY:g} s longer", is_shown=False),
    "no_verdict_points": Column("", "points without a verdict", is_shown=False),
}
"""The interval is Clopper and Pearson's for a sample (slightly too wide, without a correction for
the finite population), the share itself if all collisions were simulated.
"""


def has_reference_drivers(evaluator: Evaluator) -> bool:
    """Whether reference drivers drive instead: not in a simulator of the user's own, which drives
    itself, nor where few simulations are allowed.
    """
    return evaluator.system.mover.has("a driving system") and evaluator.left is None


def assess_sample(
    evaluator: Evaluator, collisions: Evaluations, max_simulations: int = MAX_SIMULATIONS
) -> tuple[pd.DataFrame, int]:
    """The result of `assess_collisions` for evaluated collisions, of which equal settings count
    once, and the number of these collisions.

    If that takes more than about `max_simulations` simulations, only a random sample is simulated,
    drawn with the study's seed.
    """
    _, distinct = np.unique(collisions.settings, axis=0, return_index=True)
    shuffled = np.random.default_rng(evaluator.seed).permutation(distinct)
    sample = shuffled[: max(max_simulations // len(TITLES), 1)]
    return assess_collisions(evaluator, collisions.take(sample)), len(distinct)


def avoided_shares(verdicts: pd.DataFrame) -> pd.Series[float]:
    """The share that each driver avoids of the collisions on which he has a verdict; without a
    verdict no share.
    """
    return verdicts.drop(columns="point").mean().dropna()


def drivers_frame(verdicts: pd.DataFrame, collisions: int) -> pd.DataFrame:
    """A row of `COLUMNS` for each driver, if a collision was simulated; `verdicts` are those of
    `assess_sample`.
    """
    # What each driver avoids, of the collisions with a verdict.
    rows = []
    share_of = avoided_shares(verdicts)
    drivers = [*TITLES, *(name for name in OF_LANES if name in verdicts)]
    for driver in drivers if len(verdicts) else ():
        later = f"{driver}_later"
        number = int(verdicts[driver].count())
        avoided = int(verdicts[driver].sum())
        low = high = share_of.get(driver)
        if number and len(verdicts) < collisions:
            low, high = clopper_pearson(avoided, number)
        avoided_later = int(verdicts[later].sum()) if later in verdicts else None
        points = [*filter(None, verdicts["point"][verdicts[driver].isna()].unique())]
        counts = (driver, avoided, avoided_later, number - avoided, len(verdicts) - number)
        rows.append((*counts, share_of.get(driver), low, high, share_of.get(later), points))
    return pd.DataFrame(rows, columns=[*COLUMNS]).astype(
        {
            "later": "Int64",
            "share": float,
            "share_low": float,
            "share_high": float,
            "later_share": float,
        }
    )


def avoided_by(verdicts: Mapping[Any, Any]) -> str:
    """The weakest driver who avoids a collision, in words; `verdicts` is a row of
    `assess_collisions`.
    """
    otherwise = NO_VERDICT if np.isnan(verdicts[FULL]) else NOBODY
    return next((title for driver, title in TITLES.items() if verdicts[driver] == 1), otherwise)


def assess_collisions(evaluator: Evaluator, collisions: Evaluations) -> pd.DataFrame:
    """Whether each driver avoids each of M evaluated collisions at its worst point: 1, 0, or NaN
    for no verdict.

    A driver has no verdict on a collision at a point where he collides with the original vehicle,
    too, or if he cannot be simulated. The columns are the drivers' names and `point`, the name of
    the point.
    """
    # Drivers, and those for lanes.
    system = evaluator.system
    drivers = DRIVERS | (OF_LANES if any(point.scenario.border for point in system.points) else {})
    verdicts = pd.DataFrame(np.nan, index=range(len(collisions)), columns=list(drivers)).assign(
        point=""
    )

    # Every collision at its own point.
    for index in np.unique(collisions.points).tolist():
        rows = np.flatnonzero(collisions.points == index)
        point = system.points[index]
        study = at_point(evaluator.study, point.name) if system.matrix else evaluator.study
        here = evaluator.for_study(study)
        settings = here.characteristics.of_others(system.characteristics, collisions.settings[rows])
        verdicts.loc[rows, list(drivers)] = _assess_at_point(
            here, here.system.at(here.system.points[0]), settings, drivers
        )
        verdicts.loc[rows, "point"] = point.name
    return verdicts


def _assess_at_point(
    evaluator: Evaluator,
    system: System,
    settings: FloatArray,
    drivers: Mapping[str, tuple[str, JsonObject]],
) -> FloatArray:
    """The verdicts of all drivers on M collisions at one point, shape (M, drivers)."""
    approach = approach_parameters(system)
    verdicts = dict[str, FloatArray]()
    if approach is None:
        return np.full((len(settings), len(drivers)), np.nan)
    with_original = np.concatenate([system.characteristics.original_settings, settings])
    is_led = system.points[0].scenario.pre_crash in (PreCrash.LEAD_DECELERATING, PreCrash.CUT_IN)
    is_searched = len(system.characteristics.scenario) > 0
    for driver, (model, parameters) in drivers.items():
        if (
            ANY.items() <= parameters.items() and not is_led
        ):  # nobody brakes: both conventions are one
            verdicts[driver] = verdicts[driver.replace(ANY_LEADER, LETTER)]
            continue
        ads = ModelTable(model=model, parameters={**approach, **parameters})
        verified = 0 if driver in OF_LANES else None
        with_driver = evaluator.for_study(
            replace(evaluator.study, ads=ads, spread={}), verified=verified
        )
        runs = with_driver.evaluate(with_original, REFERENCE_DRIVERS)
        avoided = np.where(runs.valid, ~runs.collided, np.nan)
        # In a searched scenario the original meets each encounter: where it is unsafe, the setting
        # is infeasible.
        has_verdict = is_searched or avoided[0] == 1
        verdicts[driver] = avoided[1:] if has_verdict else np.full(len(settings), np.nan)
    return np.column_stack(list(verdicts.values()))


def approach_parameters(system: System) -> JsonObject | None:
    """Parameters with which a reference driver approaches from rest as the driving system does with
    the original vehicle; None where encounters are ranges, where that would be the
    approach to another encounter.

    The driver replays the throttle until the driving system first brakes or reaches its peak speed,
    and holds that speed, so that both are at the same position when the danger begins. If the run
    begins at speed, the driver keeps that speed.
    """
    trace = drive_worst(system, system.characteristics.original_settings).trace
    speed = trace.speed[:, 0]
    is_braking = trace.brake[:, 0] > 0
    if speed[0] > 0 or not speed.any():
        return {}
    if len(system.characteristics.scenario):
        return None
    end = min(int(np.argmax(speed)), int(np.argmax(is_braking)) if is_braking.any() else len(speed))
    return {"cruise_speed": float(speed.max()), "start_throttle": trace.throttle[:end, 0].tolist()}
