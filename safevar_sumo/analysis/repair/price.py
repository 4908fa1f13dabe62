"""The price of a repair on a new vehicle: how much earlier it brakes, how hard, and how often needlessly; and what a
repair has not seen (step 6): other weathers, a second vehicle model, other sets of the vehicle's parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.analysis.braking import brake_onset
from safevar_sumo.analysis.model_spread import studies_of_sets
from safevar_sumo.analysis.opinion.compute import assemble_both_systems
from safevar_sumo.analysis.repair.problem import PREFIX, RepairProblem, degrees_of
from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.scenarios import WEATHERS, Point, equals_clear
from safevar_sumo.scenarios.benign import benign_points
from safevar_sumo.study import MatrixTable, Study
from safevar_sumo.sumo.matrix import evaluate, simulate_all_points
from safevar_sumo.sumo.system import System, assemble

NEEDLESS_BRAKE = 0.1
"""Brake command above which a vehicle counts as braking in a benign scene [-]; less regulates the speed."""
Values = Mapping[str, float]
"""The parameters that change, with their values in their units."""


class NewCar(NamedTuple):
    """How a new vehicle drives with some parameters through N points.

    `onsets`, shape (2, N), are where and when it begins to brake [m, s], NaN if it does not; `degrees`, shape (N,), its
    safety degrees; `deceleration` and `jerk` the largest of all points [m/s^2, m/s^3].
    """

    onsets: FloatArray
    degrees: FloatArray
    deceleration: float
    jerk: float


class Price(NamedTuple):
    """The price of changed parameters against today's, on a new vehicle.

    `mean` and `worst` are how much earlier it brakes [m], on average and at the `worst_point`, where it brakes
    `seconds` earlier; None if it brakes nowhere. `deceleration` and `jerk` are the largest [m/s^2, m/s^3]. `needless`
    counts benign scenes: all, those in which it brakes with the change, and those with today's parameters; None without
    benign scenes.
    """

    mean: float | None
    worst: float | None
    seconds: float | None
    worst_point: str
    deceleration: float
    jerk: float
    needless: tuple[int, int, int] | None = None

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


class Prices:
    """Prices of changes of a study's ADS; the new vehicle drives once with each.

    The benign scenes are those that the study names, else those like its shipped scenarios; there may be none.
    """

    def __init__(self, study: Study, system: System) -> None:
        self._study, self._points = study, system.points
        self._cars = dict[tuple[tuple[str, float], ...], NewCar]()
        self.benign = benign_points(system.points)
        if study.repair.benign:
            named = replace_in(study, matrix=MatrixTable(tests=study.repair.benign))
            self.benign = list(assemble(named).matrix)

    def of(self, values: Values) -> Price:
        """The price without needless braking."""
        car, today = self._drive(values), self._drive({})
        metres, seconds = today.onsets - car.onsets
        braked = np.flatnonzero(np.isfinite(metres))
        if not len(braked):
            return Price(None, None, None, "", car.deceleration, car.jerk)
        worst = int(braked[np.argmax(metres[braked])])
        mean, name = float(np.mean(metres[braked])), self._points[worst].name
        return Price(mean, float(metres[worst]), float(seconds[worst]), name, car.deceleration, car.jerk)

    def with_needless_braking(self, values: Values) -> Price:
        """The whole price."""
        if not self.benign:
            return self.of(values)
        repaired, original = (_brakes_in(self._system(parameters), self.benign) for parameters in (values, {}))
        return self.of(values)._replace(needless=(len(repaired), int(repaired.sum()), int(original.sum())))

    def lost_points(self, values: Values, margin: float) -> int:
        """The number of points that the new vehicle passes today and fails with the change."""
        today, car = self._drive({}), self._drive(values)
        return int(np.count_nonzero((today.degrees >= margin) & (car.degrees < margin)))

    def _system(self, values: Values) -> System:
        return assemble(with_parameters(self._study, values) if values else self._study)

    def _drive(self, values: Values) -> NewCar:
        key = tuple(values.items())
        if key not in self._cars:
            self._cars[key] = _drive_new_car(self._system(values))
        return self._cars[key]


def _drive_new_car(system: System) -> NewCar:
    """Drive the new vehicle through all points of a study."""
    results = simulate_all_points(system, system.characteristics.original[np.newaxis])
    onsets, deceleration, jerk = np.full((2, len(results)), np.nan), 0.0, 0.0
    for column, result in enumerate(results):
        trace, step = result.runs.trace, brake_onset(result.runs, 0)
        if step is not None:
            onsets[:, column] = trace.position[step, 0], trace.time[step]
        speed = trace.speed[trace.active[:, 0], 0]
        deceleration = max(deceleration, float(np.max(-np.diff(speed), initial=0.0) / trace.step))
        jerk = float(np.fmax(jerk, OPTIONAL_METRICS["max_jerk"](result.runs, system.metrics_table)[0]))
    return NewCar(onsets, np.array([result.evaluations.f_safe[0] for result in results]), deceleration, jerk)


def _brakes_in(system: System, benign: list[Point]) -> BoolArray:
    """In which benign scenes the new vehicle brakes: the given ones, and for each speed a road without anybody."""
    original = system.characteristics.original[np.newaxis]
    one_per_speed = {point.scenario.test_speed: point for point in benign}.values()
    results = [
        *simulate_all_points(replace(system, matrix=tuple(benign), rater=None), original),
        *simulate_all_points(replace(system, matrix=tuple(one_per_speed), rater=None, sees_nobody=True), original),
    ]
    traces = [result.runs.trace for result in results]
    return np.array([(np.where(trace.active, trace.brake, 0.0) > NEEDLESS_BRAKE).any() for trace in traces])


WORST_VEHICLES, SECOND_VEHICLES = 16, 11
"""Number of the worst vehicles within the promise that are driven in other weathers and with other fitted parameters;
with the second vehicle model.
"""


def check_unseen(problem: RepairProblem, values: Values, vehicles: FloatArray) -> JsonObject:
    """Count how many of the worst vehicles are safe, for each check that the study allows; `vehicles` are sorted.

    In other weathers only those vehicles count that full braking at the first possible moment keeps safe there.
    """
    study, settings = with_parameters(problem.study, values), problem.promise.settings(vehicles[:WORST_VEHICLES])
    system, show = assemble(study), problem.evaluator.progress
    best_driver = assemble(problem.best_driver.study).ads

    def are_safe(system: System, settings: FloatArray) -> BoolArray:
        if not len(settings):
            return np.zeros(0, dtype=bool)
        return np.asarray(degrees_of(evaluate(system, settings)) >= problem.margin)

    tested = {point.weather.name for point in system.points}
    others = [weather for name, weather in WEATHERS.items() if name not in tested and not equals_clear(weather)]
    checks: JsonObject = {"weathers": {}, "second_vehicle": None, "fitted_sets": None}
    for number, weather in enumerate(others):
        show("other weathers", number, len(others))
        # A point's name ends with its weather: points that differ in the weather alone are one here.
        points = {point.name.rpartition(", ")[0]: point for point in system.points}
        matrix = tuple(point._replace(weather=weather, name=name) for name, point in points.items())
        there = replace(system, matrix=matrix, weather=weather)
        try:
            repairable = settings[are_safe(replace(there, ads=best_driver), settings)]
            checks["weathers"][weather.name] = _counts(are_safe(there, repairable))
        except UserCodeError:
            continue  # a user's vehicle that knows no wet road
    try:
        show("second vehicle model", 0, 1)
        ours, second = assemble_both_systems(study)
        checks["second_vehicle"] = _counts(are_safe(replace(ours, vehicle=second), settings[:SECOND_VEHICLES]))
    except InputError:
        pass  # the model is not installed, or cannot represent the vehicle
    if study.spread:
        spread = {key: row for key, row in study.spread.items() if key.removeprefix(PREFIX) not in values}
        sets = studies_of_sets(replace_in(study, spread=spread)) if spread else []
        checks["fitted_sets"] = _counts(np.array([are_safe(assemble(variant), settings).all() for variant in sets]))
    return checks


def _counts(are_safe: BoolArray) -> JsonObject:
    return {"all": len(are_safe), "safe": int(np.count_nonzero(are_safe))}
