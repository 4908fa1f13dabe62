"""Drives vehicles in SUMO once more, with the speeds of finished runs: to check that SUMO simulates
what recorded scenes have shown, and to show all actors in pictures.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import (
    RESULT_ROUNDING,
    FloatArray,
    IntArray,
    Outcome,
    SimulationRuns,
    nans,
)
from safevar_sumo.sumo.batch import (
    drive_all,
    open_points_world,
)
from safevar_sumo.sumo.bodies import FirstContacts
from safevar_sumo.sumo.drive import enter
from safevar_sumo.sumo.encounters import met_at
from safevar_sumo.sumo.engine import Start, open_in_process
from safevar_sumo.sumo.matrix import most_at_once
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.world import SumoWorld

COMPARED = ("position", "gap", "lateral", "obstacle_speed")
"""Quantities of a trace that must be the same in SUMO [m, m/s]."""


@np.errstate(all="ignore")
def drive_again(
    system: System,
    settings: FloatArray,
    runs: SimulationRuns,
    watch: Callable[[SumoWorld], None] = lambda world: None,
    start: Start = open_in_process,
) -> dict[str, FloatArray]:
    """Drive N settings at the system's only point in SUMO, with the speeds of `runs`.

    Returns the quantities that `COMPARED` names, shape (T, N), and the `collision` speeds [m/s],
    NaN without a collision, shape (T, N). `watch` is called with SUMO's world at every sample;
    `start` may open a window.
    """
    trace = runs.trace
    n = len(runs)
    values = {name: nans(trace.speed.shape) for name in (*COMPARED, "collision")}
    vehicles, encounters = system.split(settings)
    road_system = system.at_encounters(encounters)
    point = road_system.points[0]
    with (
        system.user_code(),
        open_points_world(system, encounters, start) as (world, observer),
    ):
        motion = enter(road_system, vehicles, world).motion
        is_open = np.ones(n, bool)
        frame = world.frame
        contacts = FirstContacts(n, np.full(n, point.scenario.is_hit_in_front))
        for sample in range(len(trace.time)):
            watch(world)
            scene = observer.observe(motion)
            collisions = contacts.count(world, motion.hits, scene)
            values["collision"][sample, list(collisions)] = list(collisions.values())
            values["position"][sample] = frame.along(motion.fronts)
            for name in COMPARED[1:]:
                values[name][sample] = getattr(scene, name)
            is_open = is_open & trace.active[sample]
            is_open[list(collisions)] = False
            # A trace may be longer than the point's runs, which end before those of other points.
            if (
                sample + 1 == len(trace.time)
                or not (is_open & trace.active[sample + 1]).any()
            ):
                break
            motion = world.step(trace.speed[sample + 1], is_open)
    return values


def verify_in_sumo(system: System, settings: FloatArray, worst: IntArray) -> str:
    """Drive settings, shape (M, n), in recorded scenes, and then in SUMO with the same speeds: each
    setting at its worst point, whose number is in `worst`, shape (M,), and in a matrix at a second
    point. Returns the reason why SUMO could not simulate some of the settings; "" if it simulated
    all.

    Raises
    ------
    InputError
        If a position or a collision differs in SUMO. The error names the first such setting and
        both values.
    """
    # One point of each test is a candidate for the second points: a digest of the settings chooses
    # it. Settings take the candidates in turn; instead of its worst point a setting takes the next.
    points = system.points
    numbers_by_test = dict[Any, list[int]]()
    for number, point in enumerate(points):
        numbers_by_test.setdefault(point.parameters.get("test"), []).append(number)
    digest = zlib.crc32(settings.tobytes())
    candidates = [
        numbers[digest % len(numbers)] for numbers in numbers_by_test.values()
    ]
    second_points = np.resize(candidates, len(settings))
    second_points = np.where(
        second_points == worst, (worst + 1) % len(points), second_points
    )

    remark = ""
    size = most_at_once(system)
    for number in np.union1d(worst, second_points):
        point_system = system.at(points[number])
        is_here = (worst == number) | (second_points == number)
        point_settings = settings[is_here & met_at(points[number], system, settings)]
        for start in range(0, len(point_settings), size):
            batch = point_settings[start : start + size]
            try:
                _verify_point(point_system, batch, drive_all(point_system, batch))
            except SimulationError as error:
                remark = f"some of {len(batch)} settings could not be verified in SUMO: {error}"
    return remark


def _verify_point(system: System, settings: FloatArray, runs: SimulationRuns) -> None:
    """Verify runs at the system's only point. Batches have runs of similar length, so that few
    copies of the network wait for the longest run.
    """
    order = np.argsort(np.count_nonzero(runs.trace.active, axis=0))
    size = most_at_once(replace(system, in_sumo=True))
    for start in range(0, len(order), size):
        rows = order[start : start + size]
        _compare(system, settings[rows], runs.of(rows))


def _compare(system: System, settings: FloatArray, runs: SimulationRuns) -> None:
    """Compare the quantities of N runs in recorded scenes, shape (T, N), with the same quantities
    in SUMO. Raises an InputError about the first difference.
    """
    sumo_values = drive_again(system, settings, runs)
    trace = runs.trace
    collision = nans(trace.speed.shape)
    collision[trace.last_active, np.arange(len(settings))] = runs.collision_speed
    recorded = {
        name: np.broadcast_to(getattr(trace, name), trace.speed.shape)
        for name in COMPARED
    }
    recorded["collision"] = collision
    for name, values in recorded.items():
        differs = trace.active & ~np.isclose(
            sumo_values[name], values, rtol=0, atol=RESULT_ROUNDING, equal_nan=True
        )
        # `collision_speed` is NaN in an invalid test, also if the vehicle has hit somebody.
        if name == "collision":
            differs &= runs.outcome != Outcome.INVALID_TEST
        if differs.any():
            sample, row = np.argwhere(differs)[0]
            values_of = system.characteristics.named(settings[row]).items()
            setting = ", ".join(f"{key} = {value:.17g}" for key, value in values_of)
            raise InputError(
                system.source,
                f"{name.replace('_', ' ')} at {trace.time[sample]:g} s is {values[sample, row]:.9g}"
                f" in the recorded scene and {sumo_values[name][sample, row]:.9g} in SUMO, with"
                f" {setting}",
                "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or"
                " `engine=sumo`",
            )
