"""Systems with their settings, and made-up records: what vehicles see, their runs by speeds and
gaps, and evaluations by safety degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.case import Results, build_case
from safevar_sumo.records import (
    Encounter,
    Evaluations,
    FloatArray,
    Observation,
    Outcome,
    SimulationRuns,
    Trace,
    differences,
)
from safevar_sumo.reference.rows import COLUMNS
from safevar_sumo.results import record, solutions_frame
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import CharacteristicSet

FITS = 2
"""Number of parameter sets of the study `slippery`, with which conclusions are repeated."""
SUN = CharacteristicSet.of(load_study("sun"))
LIBRARIES = {"wear_rss": "ad_rss", "wear_idm": "highway_env"}
MISSING = [study for study, library in LIBRARIES.items() if find_spec(library) is None]
"""Shipped studies whose extra is not installed."""
HARDEST_BRAKING = """
import numpy as np
from safevar_sumo.metrics import Measure

def hardest(runs, thresholds):
    loss = np.max(-np.diff(runs.trace.speed, axis=0), axis=0, initial=0.0) / runs.trace.step
    return np.where(np.isnan(runs.collision_speed), loss, np.nan)

HARDEST = Measure(
    name="hardest", title="hardest", unit="m/s^2", more_is_unsafe=True, function=hardest
)
"""
"""The file of a user's metric, the hardest braking [m/s^2], undefined in a collision."""


def case_of(study: Study, original: Evaluations, solutions: Evaluations) -> Results:
    """A case of one run of NSGA-II with these solutions, without evaluations."""
    frame = solutions_frame(
        CharacteristicSet.of(study).names, [(("nsga2", 0), solutions)]
    )
    return build_case(study, record(original), frame, frame.iloc[:0], [("nsga2", 0)])


def made_up_runs(
    step: float,
    speed: FloatArray,
    gap: FloatArray | float = 0.0,
    collision_speed: Any = np.nan,
    **columns: FloatArray,
) -> SimulationRuns:
    """Vehicles of these speeds, shape (T, N), that end by standing or colliding; other columns of
    the trace are 0.
    """
    zero = np.zeros_like(speed)
    gaps = np.broadcast_to(gap, speed.shape)
    names = ("position", "lateral", "lateral_speed", "throttle", "brake", "gear")
    active = {"active": np.ones_like(speed, dtype=bool)}
    trace = Trace(
        step=step,
        vehicle_length=5.0,
        time=np.arange(len(speed), dtype=np.float64) * step,
        speed=speed,
        gap=gaps,
        **{**dict.fromkeys(names, zero), **active, **columns},  # type: ignore[arg-type]
    )
    crash = np.full(speed.shape[1], collision_speed)
    outcome = np.where(np.isnan(crash), Outcome.STOPPED.value, Outcome.COLLISION.value)
    return SimulationRuns(
        trace=trace,
        encounter=Encounter(gaps, gaps, speed, gaps > 0),
        outcome=outcome,
        collision_speed=crash,
    )


def seen(
    time: float,
    speed: Any,
    gap: Any,
    lateral: float = 0.0,
    visibility: float = 1.0,
    *,
    lateral_speed: float = 0.0,
    leader: float = 0.0,
    throttle: float = 0.0,
) -> Observation:
    """What vehicles observe of an obstacle with the speed `leader` ahead of them."""
    zero = np.zeros(np.size(gap))
    across = zero + lateral
    across_speed = zero + lateral_speed
    ahead = zero + leader
    return Observation(
        time,
        zero + speed,
        zero + gap,
        speed - ahead,
        across,
        across_speed,
        visibility,
        ahead,
        zero + throttle,
    )


def system_of(study: Any, **changes: Any) -> System:
    """The system of a study, which is given as to `load_study`."""
    return assemble(load_study(study, **changes))


def original_of(system: Any) -> FloatArray:
    """The original vehicle as the only row of settings."""
    return np.asarray(system.characteristics.original_settings)


def changed(system: Any, **values: float) -> FloatArray:
    """The original vehicle with some values as the only row of settings."""
    return np.asarray(system.characteristics.setting(values, beyond=True)[np.newaxis])


def uniform(characteristics: CharacteristicSet, number: int, seed: int) -> FloatArray:
    """Settings at random in the domains."""
    return np.random.default_rng(seed).uniform(
        characteristics.lower, characteristics.upper, (number, len(characteristics))
    )


def published_rows(
    characteristics: CharacteristicSet,
    settings: FloatArray,
    metrics: Mapping[str, FloatArray],
) -> pd.DataFrame:
    """Settings and their metrics in the published format, which has 0 for what is undefined."""
    columns = {name: np.nan_to_num(metrics[key]) for key, name in COLUMNS.items()}
    frame = pd.DataFrame(settings, columns=list(characteristics.names))
    return frame.assign(**columns)


def drawn(system: Any, number: int, seed: int) -> FloatArray:
    """The original vehicle and settings at random, those that a region allows."""
    members = system.characteristics
    settings = uniform(members, number, seed)
    settings[0] = members.original
    settings = np.asarray(members.filter(settings))
    return np.asarray(settings[system.region.feasible(settings)])


def made_up_evaluations(safety: Any, **columns: Any) -> Evaluations:
    """Vehicles of these safety degrees: collisions where these are 0 or less."""
    values = np.asarray(safety, dtype=float)
    collided = values <= 0
    made_up = {
        "settings": np.ones((len(values), 1)),
        "outcome": np.where(collided, "collision", "stopped").astype("U16"),
        "collision_speed": np.where(collided, -values, np.nan),
        "metrics": {"safety_degree": values},
        "f_diff": np.zeros(len(values)),
        "f_num_diff": np.zeros(len(values)),
    }
    return Evaluations(**{**made_up, **columns})


def assert_same_results(one: Evaluations, other: Evaluations) -> None:
    """All results of the same settings are equal, to the bit."""
    assert one.results.keys() == other.results.keys()
    assert not [*differences(one.results, other.results)]
