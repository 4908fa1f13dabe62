"""The price of a repair on a new vehicle: how much earlier it brakes, how hard, and how often needlessly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.explain.braking_comparison import brake_onset
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.benign import benign_points
from safevar_sumo.study import MatrixTable, Study
from safevar_sumo.sumo.matrix import PointResult, simulate_all_points
from safevar_sumo.sumo.system import System, assemble

NEEDLESS_BRAKE = 0.1
"""Brake command above which a vehicle counts as braking in a benign scene [-]; less regulates the speed."""


class NewCar(NamedTuple):
    """How a new vehicle drives with some parameters: by point, where and when it begins to brake [m, s], NaN if it does
    not, its safety degree; the largest deceleration and jerk of all points [m/s^2, m/s^3]; the benign scenes in which
    it brakes, None without any.
    """

    position: FloatArray
    time: FloatArray
    degrees: FloatArray
    deceleration: float
    jerk: float
    needless: BoolArray | None


class Price(NamedTuple):
    """The price of parameters against today's [m, s, m/s^2, m/s^3].

    `needless` is the numbers of benign scenes, of those in which it brakes with the repair, and with today's
    parameters; None without benign scenes.
    """

    mean: float | None
    worst: float | None
    seconds: float | None
    worst_point: str
    deceleration: float
    jerk: float
    needless: tuple[int, int, int] | None

    def to_dict(self) -> JsonObject:
        """The entry `price` of a repair's JSON."""
        scenes, repaired, original = self.needless or (0, None, None)
        return {
            "metres_earlier": {"mean": self.mean, "worst": self.worst},
            "seconds_earlier": self.seconds,
            "largest_deceleration": self.deceleration,
            "largest_jerk": self.jerk,
            "needless_braking": {"scenes": scenes, "repaired": repaired, "original": original},
            "points": None,
        }


def drive_new_car(study: Study, values: Mapping[str, float], benign: Sequence[Point]) -> NewCar:
    """Drive the new vehicle through the study and its benign scenes, with some parameters of its ADS."""
    system = assemble(with_parameters(study, values) if values else study)
    original = system.characteristics.original[np.newaxis]
    results = simulate_all_points(system, original)
    onsets = [brake_onset(result.runs, 0) for result in results]
    begins = np.full((2, len(results)), np.nan)
    for column, (result, onset) in enumerate(zip(results, onsets, strict=True)):
        if onset is not None:
            begins[:, column] = result.runs.trace.position[onset, 0], result.runs.trace.time[onset]
    jerk = OPTIONAL_METRICS["max_jerk"]
    jerks = [float(jerk(result.runs, system.metrics_table)[0]) for result in results]
    return NewCar(
        begins[0],
        begins[1],
        np.array([float(result.evaluations.f_safe[0]) for result in results]),
        max(_deceleration(result) for result in results),
        max((value for value in jerks if np.isfinite(value)), default=0.0),
        np.array(_brakes_in(system, benign)) if benign else None,
    )


def _deceleration(result: PointResult) -> float:
    """The largest deceleration from one sample to the next [m/s^2]."""
    trace = result.runs.trace
    speed = trace.speed[trace.active[:, 0], 0]
    return float(np.max(-np.diff(speed), initial=0.0) / trace.step)


def _brakes_in(system: System, benign: Sequence[Point]) -> list[bool]:
    """In which benign scenes the new vehicle brakes; with every speed also without anybody."""
    original = system.characteristics.original[np.newaxis]
    empty = {point.scenario.test_speed: point for point in benign}.values()
    results = [
        *simulate_all_points(replace(system, matrix=tuple(benign), rater=None), original),
        *simulate_all_points(replace(system, matrix=tuple(empty), rater=None, sees_nobody=True), original),
    ]
    return [
        bool((np.where(result.runs.trace.active, result.runs.trace.brake, 0.0) > NEEDLESS_BRAKE).any())
        for result in results
    ]


def benign_scenes(study: Study, system: System) -> list[Point]:
    """The benign scenes that the study names, else those like its shipped scenarios; empty if there are none."""
    if study.repair.benign:
        named = msgspec.structs.replace(study, matrix=MatrixTable(tests=study.repair.benign))
        return list(assemble(named).matrix)
    return benign_points(system.points)


def price_of(system: System, car: NewCar, today: NewCar) -> Price:
    """The price of a repair, from the new vehicle with and without it."""
    metres, seconds = today.position - car.position, today.time - car.time
    braked = np.flatnonzero(np.isfinite(metres))
    worst = int(braked[np.argmax(metres[braked])]) if len(braked) else None
    return Price(
        mean=float(np.mean(metres[braked])) if len(braked) else None,
        worst=None if worst is None else float(metres[worst]),
        seconds=None if worst is None else float(seconds[worst]),
        worst_point="" if worst is None else system.points[worst].name,
        deceleration=car.deceleration,
        jerk=car.jerk,
        needless=None
        if car.needless is None or today.needless is None
        else (len(car.needless), int(car.needless.sum()), int(today.needless.sum())),
    )
