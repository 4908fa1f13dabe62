"""The price of a repair on a new vehicle: how much earlier it brakes, how hard, and how often needlessly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.analysis.braking import brake_onset
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.benign import benign_points
from safevar_sumo.study import MatrixTable, Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System, assemble

NEEDLESS_BRAKE = 0.1
"""Brake command above which a vehicle counts as braking in a benign scene [-]; less regulates the speed."""


class Price(NamedTuple):
    """The price of changed parameters against today's, on a new vehicle.

    `metres_earlier` and `seconds_earlier` are how much earlier it brakes at the point where these are most metres, at
    most, and `metres_earlier_mean` on average [m, s]; None if it brakes nowhere. `largest_deceleration` is
    that with the change [m/s^2]. `needless_braking` of the `benign_scenes` are those in
    which it brakes with the change, `needless_braking_today` those with today's parameters.
    """

    metres_earlier: float | None
    metres_earlier_mean: float | None
    seconds_earlier: float | None
    most_at: str
    largest_deceleration: float
    needless_braking: int
    needless_braking_today: int
    benign_scenes: int


def price_of(study: Study, values: Mapping[str, float]) -> Price:
    """The price of other values of parameters."""
    today, changed = assemble(study), assemble(with_parameters(study, values))
    onsets_today, _ = _drive_new_car(today)
    onsets, deceleration = _drive_new_car(changed)
    benign = benign_scenes(study, today)
    before, after = (needless_braking(system, benign) for system in (today, changed))
    metres, seconds = onsets_today - onsets
    braked = np.flatnonzero(np.isfinite(metres))
    earlier: tuple[float | None, float | None, float | None, str] = (None, None, None, "")
    if len(braked):
        most = int(braked[np.argmax(metres[braked])])
        earlier = float(metres[most]), float(np.mean(metres[braked])), float(seconds[most]), today.points[most].name
    return Price(*earlier, deceleration, sum(after), sum(before), len(after))


def _drive_new_car(system: System) -> tuple[FloatArray, float]:
    """Where and when the new vehicle begins to brake at each of N points, shape (2, N), NaN if it does not [m, s]; its
    largest deceleration [m/s^2].
    """
    results = simulate_all_points(system, system.characteristics.original[np.newaxis])
    onsets, deceleration = np.full((2, len(results)), np.nan), 0.0
    for column, result in enumerate(results):
        trace, step = result.runs.trace, brake_onset(result.runs, 0)
        if step is not None:
            onsets[:, column] = trace.position[step, 0], trace.time[step]
        speed = trace.speed[trace.active[:, 0], 0]
        deceleration = max(deceleration, float(np.max(-np.diff(speed), initial=0.0) / trace.step))
    return onsets, deceleration


def benign_scenes(study: Study, system: System) -> list[Point]:
    """The benign scenes that a study names, else those like its shipped scenarios; there may be none."""
    if study.repair.benign:
        return list(assemble(replace_in(study, matrix=MatrixTable(tests=study.repair.benign))).matrix)
    return benign_points(system.points)


def needless_braking(system: System, benign: list[Point]) -> list[bool]:
    """In which benign scenes the new vehicle brakes: the given ones, and for each speed a road without anybody."""
    one_per_speed = {point.scenario.test_speed: point for point in benign}.values()
    return [
        bool((np.where(result.runs.trace.active, result.runs.trace.brake, 0.0) > NEEDLESS_BRAKE).any())
        for points, sees_nobody in ((benign, False), (one_per_speed, True))
        if points
        for result in simulate_all_points(
            replace(system, matrix=tuple(points), rater=None, sees_nobody=sees_nobody),
            system.characteristics.original[np.newaxis],
        )
    ]
