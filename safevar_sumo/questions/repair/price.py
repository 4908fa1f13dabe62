"""The price of a repair: how much earlier and how hard a new vehicle brakes with the repair, and
how often it brakes needlessly.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.questions.braking import brake_onset
from safevar_sumo.records import FloatArray, JsonObject, NamedValues
from safevar_sumo.scenarios import Point
from safevar_sumo.study import MatrixTable, Study
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System, assemble

NEEDLESS_BRAKE = 0.1
"""Brake command above which a vehicle counts as braking in a benign scene [-]. A smaller command
only regulates the speed.
"""

OF_BRAKING = ("metres_earlier", "metres_earlier_mean", "seconds_earlier", "most_at")
"""Columns that say how much earlier a vehicle brakes, and at which point the difference is largest.
"""


def price_of(study: Study, values: NamedValues, encounters: FloatArray) -> JsonObject:
    """The price of new values of parameters in comparison with today's values, by the names of the
    answer's columns. Values of `OF_BRAKING` are None if the new vehicle brakes nowhere.
    `encounters` are the new vehicle in K encounters, shape (K, n).
    """
    today = assemble(study)
    changed = assemble(with_parameters(study, values))
    onsets_today, _ = drive_new_cars(today, encounters)
    onsets, deceleration = drive_new_cars(changed, encounters)
    benign = benign_scenes(study, today)
    needless_today = needless_braking(today, benign)
    needless = needless_braking(changed, benign)
    metres, seconds = onsets_today - onsets
    braked = np.flatnonzero(np.isfinite(metres))
    price = dict.fromkeys(OF_BRAKING)
    if len(braked):
        row = braked[np.argmax(metres[braked])]
        point = today.points[row // len(encounters)].name or None
        earlier = (metres[row], np.mean(metres[braked]), seconds[row])
        price = dict(zip(OF_BRAKING, (*map(float, earlier), point), strict=True))
    count = count_today = None
    if needless:
        count = sum(needless)
        count_today = sum(needless_today)
    return price | {
        "largest_deceleration": deceleration,
        "needless_braking": count,
        "needless_braking_today": count_today,
        "benign_scenes": len(needless),
    }


def drive_new_cars(system: System, encounters: FloatArray) -> tuple[FloatArray, float]:
    """The positions [m] and times [s] at which the new vehicle begins to brake at each of N points
    in each of K encounters, shape (2, N K), NaN if it does not brake; and its largest deceleration
    [m/s^2].
    """
    onsets = []
    deceleration = 0.0
    for result, row in product(
        simulate_all_points(system, encounters), range(len(encounters))
    ):
        trace = result.runs.trace
        step = brake_onset(result.runs, row)
        onset = np.nan, np.nan
        if step is not None:
            onset = trace.position[step, row], trace.time[step]
        onsets.append(onset)
        speed = trace.speed[trace.active[:, row], row]
        decelerations = -np.diff(speed) / trace.step
        deceleration = max(deceleration, float(np.max(decelerations, initial=0.0)))
    return np.transpose(onsets), deceleration


def benign_scenes(study: Study, system: System) -> list[Point]:
    """The benign scenes of a study, in which nobody needs to brake: those that the study names, or
    else those that its scenarios know. The scenarios' scenes are taken in three encounters: the
    original one, and those with all searched parameters at their lower or at their upper ends. A
    study may have no benign scene.
    """
    if study.repair.benign:
        matrix = MatrixTable(tests=study.repair.benign)
        return list(assemble(replace_in(study, matrix=matrix)).matrix)
    searched = system.characteristics.scenario
    ends = [searched.original, searched.lower, searched.upper]
    scenes = dict[str, Point]()
    with system.user_code():
        for values, listed_point in product(map(searched.named, ends), system.points):
            point = encounter(listed_point, values)
            for description, scenario in point.scenario.benign():
                name = f"{description}, {point.weather.name}"
                scenes.setdefault(name, Point(scenario, point.weather, name))
    return list(scenes.values())


def needless_braking(system: System, benign: list[Point]) -> list[bool]:
    """Whether the new vehicle brakes in each scene: in each benign scene and, for each speed of
    these scenes, on a road on which the vehicle sees nobody.
    """
    if not benign:
        return []
    vehicle = system.characteristics.vehicle
    with_scenes = replace(system, points=tuple(benign), characteristics=vehicle)
    one_per_speed = {point.scenario.test_speed: point for point in benign}.values()
    without_actors = replace(with_scenes, points=tuple(one_per_speed), sees_nobody=True)
    brakes = []
    for variant in (with_scenes, without_actors):
        for result in simulate_all_points(variant, vehicle.original_settings):
            trace = result.runs.trace
            is_braking = trace.active & (trace.brake > NEEDLESS_BRAKE)
            brakes.append(bool(is_braking.any()))
    return brakes
