"""Driven speeds once more in SUMO: what was recorded must be what SUMO simulates, and pictures show
all actors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.plugins import user_errors
from safevar_sumo.records import (
    ROUNDING,
    BoolArray,
    Evaluations,
    FloatArray,
    IntArray,
    Outcome,
    SimulationRuns,
)
from safevar_sumo.sumo.batch import observer_of, open_points_world, traffic_of
from safevar_sumo.sumo.bodies import FirstContacts
from safevar_sumo.sumo.drive import enter
from safevar_sumo.sumo.engine import Engine, Start, open_in_process
from safevar_sumo.sumo.matrix import batch_size, settings_per_batch, simulate_groups
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.world import SumoWorld

SPREAD_POINTS = 16
"""Number of points of a matrix, spread over all, at which settings are verified; and one of each
test that has none of them.
"""
RATED_POINTS = 8
"""That number of a rating's points."""
SAFE_POINTS = 6
"""Number of points that a sample's safe simulations fill first, or one of each test."""
FIRST_OTHERS = 8
"""Least number of other settings that are simulated together with the unsafe ones of a sample."""
COMPARED = ("position", "gap", "lateral", "obstacle_speed")
"""Quantities of a trace that SUMO must repeat [m, m/s]."""


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
    n = len(runs.outcome)
    values = {name: np.full(trace.speed.shape, np.nan) for name in (*COMPARED, "collision")}
    vehicles, encounters = system.cut(settings)
    on_road = system.at_encounters(encounters)
    point = on_road.points[0]
    traffic = traffic_of(system, encounters)
    with user_errors(system.source), open_points_world(system, encounters, traffic, start) as world:
        motion = enter(on_road, vehicles, world).motion
        observer = observer_of(point.scenario, world, traffic)
        is_open = np.ones(n, dtype=bool)
        frame = world.frame
        contacts = FirstContacts(n, np.full(n, point.scenario.is_hit_in_front))
        for sample in range(len(trace.time)):
            watch(world)
            scene = observer.observe(motion, is_open)
            collisions = contacts.count(world, motion.hits, scene)
            values["collision"][sample, [*collisions]] = [*collisions.values()]
            values["position"][sample] = frame.along(motion.fronts)
            for name in COMPARED[1:]:
                values[name][sample] = getattr(scene, name)
            is_open = is_open & trace.active[sample]
            is_open[[*collisions]] = False
            # A trace may be longer than the point's runs, which end before those of other points.
            if sample + 1 == len(trace.time) or not (is_open & trace.active[sample + 1]).any():
                break
            motion = world.step(trace.speed[sample + 1], is_open)
    return values


def verify_in_sumo(system: System, settings: FloatArray) -> str:
    """Drive settings, shape (M, n), in recorded scenes, and with the same speeds in SUMO, at every
    point or, of a rating, at some. Returns why SUMO could not simulate some of them, "" if it
    could.

    Raises
    ------
    InputError
        If a place or a collision is another one in SUMO, with the first such setting and both
        values.
    """
    points = system.points
    if system.rater is not None:
        points = tuple(points[number] for number in spread_points(system))
    reduced = replace(system, matrix=points, rater=None)
    remark = ""
    size = batch_size(system, Engine.RECORDED)
    for start in range(0, len(settings), size):
        batch = settings[start : start + size]
        for result in chain.from_iterable(simulate_groups(reduced, batch)):
            try:
                _verify_point(system.at(result.point), batch, result.runs)
            except SimulationError as error:
                remark = f"some of {len(batch)} settings could not be verified in SUMO: {error}"
    return remark


class Sample(NamedTuple):
    """What SUMO repeats of a search: each of K unsafe settings, shape (K, n), at its worst point,
    whose number is in `worst`, and `number` safe simulations of these and other settings, shape
    (M, n), at `points`.
    """

    unsafe: FloatArray
    worst: IntArray
    others: FloatArray
    number: int
    points: Sequence[int]


def spread_points(system: System) -> list[int]:
    """Numbers of some points of a system: evenly spread over all, and one of every test; of a
    rating, whose points take SUMO long, fewer and not of every test.
    """
    points = system.points
    if system.rater is not None:
        return [int(k) for k in np.linspace(0, len(points) - 1, min(RATED_POINTS, len(points)))]
    tests = [dict(point.parameters).get("test") for point in points]
    evenly = {
        *np.linspace(0, len(points) - 1, min(SPREAD_POINTS, len(points))).astype(int).tolist()
    }
    missed = {*tests} - {tests[number] for number in evenly}
    return sorted(evenly | {tests.index(test) for test in missed})


def verify_sample(
    system: System, criterion: Unsafe, sample: Sample, show: Callable[[int], None]
) -> tuple[int, str]:
    """Repeat a sample of recorded simulations in SUMO. Returns the number of safe simulations among
    them, and why SUMO could not simulate some, "" if it could; `show` is called with the number of
    all that are repeated. Raises the error of `verify_in_sumo`.
    """
    if criterion.is_of_points:  # which no single simulation has
        criterion = Unsafe()
    remark = ""
    repeated = safe = 0
    numbers = sorted({*sample.points, *sample.worst.tolist()})
    by_name = {system.points[number].name: number for number in numbers}
    reduced = replace(system, matrix=tuple(system.points[number] for number in numbers), rater=None)

    # The unsafe settings follow a few others; further others come until enough are safe.
    enough = math.ceil(5 * sample.number / len(sample.points))
    first = min(max(enough - len(sample.unsafe), FIRST_OTHERS), len(sample.others))
    settings = np.concatenate([sample.others[:first], sample.unsafe, sample.others[first:]])
    worst = np.full(len(settings), -1)
    worst[first : first + len(sample.unsafe)] = sample.worst
    largest = settings_per_batch(system, Engine.RECORDED)
    size = min(largest, max(first + len(sample.unsafe), 1))
    start = 0
    while start < len(settings) and (safe < sample.number or start < first + len(sample.unsafe)):
        batch = settings[start : start + size]
        results = [*chain.from_iterable(simulate_groups(reduced, batch))]
        numbers = [by_name[result.point.name] for result in results]
        are_safe = [
            ~criterion.of(result.evaluations) & ~result.evaluations.failed for result in results
        ]

        # Of every test the point with the most safe simulations, then those with the most.
        counts = np.array([np.count_nonzero(is_safe) for is_safe in are_safe])
        tests = [dict(result.point.parameters).get("test") for result in results]
        most_first = np.argsort(-counts, kind="stable").tolist()
        best = dict.fromkeys(tests[place] for place in most_first)
        best = {test: next(k for k in most_first if tests[k] == test) for test in best}
        order = [*dict.fromkeys([*best.values(), *most_first])]
        shared = min(max(SAFE_POINTS, len(best)), len(order))
        for turn, place in enumerate(order):
            result = results[place]
            is_repeated = worst[start : start + size] == numbers[place]
            if numbers[place] in sample.points:
                count = math.ceil((sample.number - safe) / max(shared - turn, 1))
                chosen = _sampled(criterion, result.evaluations, are_safe[place], count)
                safe += len(chosen)
                is_repeated[chosen] = True
            rows = np.flatnonzero(is_repeated)
            if not len(rows):
                continue
            try:
                _verify_point(system.at(result.point), batch[rows], result.runs.of(rows))
            except SimulationError as error:
                remark = f"some of {len(rows)} settings could not be verified in SUMO: {error}"
            repeated += len(rows)
            show(repeated)

        # As many further settings as are expected to bring the missing safe simulations.
        start += size
        if start >= first + len(sample.unsafe):
            size = math.ceil(start * (sample.number - safe) / max(safe, 1))
            size = min(max(size, FIRST_OTHERS), largest)
    return safe, remark


def _sampled(
    criterion: Unsafe, evaluations: Evaluations, is_safe: BoolArray, number: int
) -> IntArray:
    """Rows of `number` safe simulations: half of them with the least clearance, the first of each
    kind of outcome, and others spread over all.
    """
    if number <= 0:
        return np.zeros(0, dtype=np.intp)
    rows = np.flatnonzero(is_safe)
    least_first = rows[np.argsort(criterion.robustness(evaluations)[rows], kind="stable")]
    _, first = np.unique(evaluations.outcome[rows], return_index=True)
    chosen = np.union1d(least_first[: math.ceil(number / 2)], rows[first])
    left = np.setdiff1d(rows, chosen)
    missing = min(max(number - len(chosen), 0), len(left))
    spread = np.linspace(0, len(left) - 1, missing).astype(int)
    return np.union1d(chosen, left[spread])


def _verify_point(system: System, settings: FloatArray, runs: SimulationRuns) -> None:
    """Verify runs at the only point; runs of similar length together, so that few copies wait for
    the longest.
    """
    order = np.argsort(np.count_nonzero(runs.trace.active, axis=0))
    size = batch_size(system, Engine.LIBSUMO)
    for start in range(0, len(order), size):
        rows = order[start : start + size]
        chosen = runs.of(rows)
        in_sumo = drive_again(system, settings[rows], chosen)
        _compare(system, settings[rows], chosen, in_sumo)


def _compare(
    system: System, settings: FloatArray, runs: SimulationRuns, in_sumo: dict[str, FloatArray]
) -> None:
    """Compare the quantities of N recorded runs, shape (T, N), with those in SUMO; raises the first
    difference.
    """
    trace = runs.trace
    last = len(trace.time) - 1 - np.argmax(trace.active[::-1], axis=0)
    collision = np.full(trace.speed.shape, np.nan)
    collision[last, np.arange(len(last))] = runs.collision_speed
    recorded = {name: np.broadcast_to(getattr(trace, name), trace.speed.shape) for name in COMPARED}
    recorded["collision"] = collision
    for name, values in recorded.items():
        differs = trace.active & ~np.isclose(
            in_sumo[name], values, rtol=0, atol=ROUNDING, equal_nan=True
        )
        if name == "collision":  # an invalid test has none
            differs &= runs.outcome != Outcome.INVALID_TEST
        if differs.any():
            sample, row = np.argwhere(differs)[0]
            pairs = zip(system.characteristics.names, settings[row].tolist(), strict=True)
            setting = ", ".join(f"{key} = {value:.17g}" for key, value in pairs)
            raise InputError(
                system.source,
                f"{name.replace('_', ' ')} at {trace.time[sample]:g} s is {values[sample, row]:.9g}"
                f" in the recorded scene and {in_sumo[name][sample, row]:.9g} in SUMO, with"
                f" {setting}",
                "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or"
                " `engine=sumo`",
            )
