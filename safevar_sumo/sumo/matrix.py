"""Evaluates settings at the points of a study: its only scenario, or the points of a matrix. In a
matrix the worst point decides about a setting.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import UserCodeError
from safevar_sumo.metrics import STOPPING_DISTANCE
from safevar_sumo.records import (
    Evaluations,
    FloatArray,
    IntArray,
    JsonObject,
    Outcome,
    SimulationRuns,
    finite_or_none,
)
from safevar_sumo.scenarios import Point, TrackScenario
from safevar_sumo.scenarios.tracks import KMH
from safevar_sumo.study import ORIGINAL_DEGREE, PHASE, SAFETY_DEGREE
from safevar_sumo.sumo.batch import drive_all, reason_against_scenes, score
from safevar_sumo.sumo.encounters import in_place_of_unmet, met_at, worst_points
from safevar_sumo.sumo.network import number_of_lanes, open_network
from safevar_sumo.sumo.system import System

MAX_COPIES = 200
"""Largest number of copies of a network in one simulation; with more, the processor's caches
overflow, and each copy takes longer.
"""
MAX_VEHICLES = 4000
"""Largest number of vehicles in recorded scenes at once; 200 steps of these vehicles take about 200
MB.
"""
LONG_RUN = 60.0
"""Length of a run up to which `MAX_VEHICLES` drive at once [s]. In longer runs fewer vehicles
drive at once, because traces take memory.
"""
MAX_LANES = 100_000
"""Largest number of lanes in all copies of one simulation; loading more lanes takes minutes and
gigabytes.
"""


class PointResult(NamedTuple):
    """Simulation runs and evaluations of N settings at one point of a study."""

    point: Point
    evaluations: Evaluations
    runs: SimulationRuns


def point_record(result: PointResult) -> JsonObject:
    """Plain values of the first setting of a result; a value is None if it is undefined.

    Keys: the point and the outcome; impact speeds [m/s]; safety degree and gap [m]; the largest
    deviation from the test speed before the ADS acted [km/h]; the time to collision at the first
    warning [s]; the side of the contact, and the position along that side [%].
    """
    evaluations = result.evaluations
    runs = result.runs
    values = {
        "impact_speed": evaluations.collision_speed[0],
        "relative_impact_speed": runs.relative_speed[0],
        SAFETY_DEGREE: evaluations.f_safe[0],
        "gap": evaluations.gaps(runs.middles_apart)[0],
        "test_speed_error": np.ravel(runs.test_speed_error)[0] / KMH,
        "warning_ttc": np.ravel(runs.warning_ttc)[0],
    }
    if STOPPING_DISTANCE.name in evaluations.metrics:
        values[STOPPING_DISTANCE.name] = evaluations.metrics[STOPPING_DISTANCE.name][0]
    record = {
        "point": result.point.name,
        **result.point.parameters,
        "outcome": str(evaluations.outcome[0]),
    }
    for name, value in values.items():
        record[name] = finite_or_none(value)
    side = str(np.ravel(runs.contact.side)[0])
    if side:
        place = float(np.ravel(runs.contact.place)[0])
        record["contact"] = {"side": side, "place": place}
    return record


def vehicle_remarks(system: System) -> list[str]:
    """Remarks for the user on a vehicle that is tested at higher speeds than the speeds to which
    its model was fitted.
    """
    fitted_speed = system.vehicle.FITTED_UP_TO
    test_speed = max(scenario.test_speed or 0.0 for scenario in system.scenarios)
    if test_speed <= fitted_speed:
        return []

    # The drag at the test speed lets a user judge how wrong the model is at this speed.
    tables = system.nominal.tables()
    speed = min(test_speed, float(tables.speeds[-1]))
    drag = np.interp(speed, tables.speeds, tables.coasting)
    return [
        f"The vehicle was fitted to drives of up to {fitted_speed / KMH:.0f} km/h, and is tested at"
        f" up to {test_speed / KMH:.0f} km/h. Beyond its fit the model extrapolates: with the"
        f" accelerator released, it loses {drag:.1f} m/s^2 at {speed / KMH:.0f} km/h."
    ]


def drive_and_score(
    system: System, settings: FloatArray, *, with_originals: bool = True
) -> Evaluations:
    """Simulate and score settings, shape (N, n), in as few batches as fit. Vehicles drive the
    settings unfiltered.

    A pure function: row i of the result depends only on row i of `settings`, to the last bit (if
    a study skips failures, and user code other than a simulator fails, all rows fail). In a
    matrix, row i holds the result of setting i at its worst point. If encounters count only where
    the original vehicle is safe, the original drives in each encounter, too, and row i also holds
    its safety degree. This is left out if `with_originals` is false.
    """
    # The original drives beside each setting, so that only half as many settings fit.
    takes_pairs = with_originals and system.measuring.scoring.safe_original is not None
    size = max(1, most_at_once(system) // (system.repeats * (1 + takes_pairs)))
    if len(settings) > size:
        batches = np.split(settings, range(size, len(settings), size))
        with system.modules.active():
            return Evaluations.concatenate(
                [
                    drive_and_score(system, batch, with_originals=with_originals)
                    for batch in batches
                ]
            )

    vehicles = settings
    if takes_pairs:
        originals = system.characteristics.with_original_vehicle(settings)
        vehicles, rows, original_rows = _beside(system, settings, originals)

    try:
        if system.matrix:
            evaluations = evaluate_matrix(system, vehicles)
        else:
            evaluations = score(system, vehicles, drive_all(system, vehicles))
    except UserCodeError as error:
        if not system.skips_failed:
            raise
        # A batch of a user's simulator has one setting: no other setting fails with it.
        reason = " ".join(f"{error.source}: {error.problem}".split())
        changes = system.characteristics.change_objectives(vehicles)
        reasons = {row.tobytes(): reason for row in vehicles}
        evaluations = Evaluations.undefined(
            vehicles,
            Outcome.SIMULATOR_ERROR,
            system.measuring.measures,
            reasons=reasons,
            **changes,
        )
    if not takes_pairs:
        return evaluations

    beside = evaluations.take(rows)
    metrics = {**beside.metrics, ORIGINAL_DEGREE: evaluations.f_safe[original_rows]}
    return replace(beside, metrics=metrics)


def _beside(
    system: System, settings: FloatArray, originals: FloatArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Join settings and the original vehicle in their encounters, both of shape (N, n), into one
    array. Returns the array, the row of each setting, and the row of each setting's original.
    """
    rows = np.arange(len(settings))
    # Among bodies on tracks one run of the original serves all settings with the same encounter.
    if system.has_tracks:
        distinct, places = np.unique(originals, axis=0, return_inverse=True)
        return np.concatenate([settings, distinct]), rows, len(rows) + np.ravel(places)
    # In recorded scenes a setting and its original are neighbours, because a pair shares a scene.
    vehicles = np.stack([settings, originals], axis=1).reshape(-1, settings.shape[1])
    return vehicles, 2 * rows, 2 * rows + 1


def evaluate_matrix(system: System, settings: FloatArray) -> Evaluations:
    """Evaluate settings, shape (N, n), at their worst points."""
    evaluations_by_point = evaluate_points(system, settings)
    numbers = worst_points(system, evaluations_by_point)
    rows = numbers * len(settings) + np.arange(len(settings))
    return replace(
        Evaluations.concatenate(evaluations_by_point).take(rows), worst_points=numbers
    )


def evaluate_points(system: System, settings: FloatArray) -> list[Evaluations]:
    """Evaluations of settings, shape (N, n), at every point, in the points' order. Traces are
    dropped, because the traces of all points would take gigabytes.
    """
    evaluations = {}
    for result in _simulate_unordered(system, settings):
        evaluations[result.point.name] = result.evaluations
    return [evaluations[point.name] for point in system.points]


def efficient_batch(system: System) -> int:
    """Number of settings in an efficient batch, which a worker gets at once."""
    # The journal gets the results of a batch at its end: an interruption must not lose more than
    # one long simulation.
    if system.mover.takes_long:
        return 1
    if reason_against_scenes(system):
        return MAX_COPIES
    # The original vehicle drives beside each setting; points are simulated one after another.
    if len(system.characteristics.scenario):
        return most_in_memory(system) // 2
    # A step costs about as much for few vehicles as for many: smaller batches would save nothing.
    return max(most_in_memory(system) // len(system.points), MAX_COPIES)


def most_in_memory(system: System) -> int:
    """Largest number of vehicles in one batch, by memory. Long runs, and an ADS that is an FMU for
    each vehicle, make it smaller.
    """
    longest = max(float(np.max(scenario.duration)) for scenario in system.scenarios)
    memory_limit = round(MAX_VEHICLES * min(LONG_RUN / longest, 1.0))
    return min(memory_limit, system.ads.max_vehicles or memory_limit)


def most_at_once(system: System) -> int:
    """Largest number of vehicles in one simulation, by memory, and in copies of the largest network
    by its lanes.
    """
    if system.mover.takes_long:
        return 1
    if not reason_against_scenes(system):
        return most_in_memory(system)
    lanes = max(number_of_lanes(open_network(name)) for name in system.networks)
    return min(max(MAX_LANES // max(lanes, 1), 1), MAX_COPIES, most_in_memory(system))


def drive_worst(system: System, settings: FloatArray) -> SimulationRuns:
    """Simulate every setting, shape (N, n), once.

    In a matrix, all settings run at the worst point of the last setting, so that other settings,
    such as the original, can be compared with it. Raises the errors of `drive_all`.
    """
    return drive_all(system.at(worst_point(system, settings[-1])), settings)


def simulate_all_points(system: System, settings: FloatArray) -> list[PointResult]:
    """Simulate settings, shape (N, n), at every point; results are in the points' order. Raises the
    errors of `drive_all`.
    """
    names = [point.name for point in system.points]
    results = _simulate_unordered(system, settings)
    return sorted(results, key=lambda result: names.index(result.point.name))


def _simulate_unordered(system: System, settings: FloatArray) -> Iterator[PointResult]:
    """Yield the results of settings at every point, group by group of points that share a
    simulation.
    """
    number = len(settings)

    groups: Iterable[tuple[Point, ...]] = ((point,) for point in system.points)
    searched = {*system.characteristics.scenario.names}
    are_met = all(met_at(point, system, settings).all() for point in system.points)
    # Points share a simulation only if all settings meet them. A range of any parameter but the
    # phase may give each setting a scenario of its own.
    if are_met and searched <= {PHASE} and not reason_against_scenes(system):
        groups = _group_points(system, max(most_in_memory(system) // max(number, 1), 1))
    for points in groups:
        # Settings that do not meet a point, which then is alone, get the original encounter of the
        # point, so that row i stays setting i. Their results are replaced below.
        is_met = met_at(points[0], system, settings)
        vehicles = in_place_of_unmet(points[0], system, settings, is_met)
        runs = drive_all(replace(system, points=points), vehicles)
        evaluations = score(system, np.tile(settings, (len(points), 1)), runs)
        if not is_met.all():
            evaluations = evaluations.keep_only(is_met, Outcome.INFEASIBLE)
        for k, point in enumerate(points):
            rows = slice(k * number, (k + 1) * number)
            yield PointResult(point, evaluations.take(rows), runs.of(rows))


def worst_point(system: System, setting: FloatArray) -> Point:
    """The worst point of a setting, shape (n,); see `worst_points`."""
    if not system.matrix:
        return system.points[0]
    evaluations_by_point = evaluate_points(system, setting[np.newaxis])
    return system.points[int(worst_points(system, evaluations_by_point)[0])]


def _group_points(system: System, size: int) -> Iterator[tuple[Point, ...]]:
    """Yield groups of at most `size` points that may share a batch, sorted by duration.

    Points share a batch if their scenarios are tracks around vehicles of equal size; any other
    point is alone. If one batch does not hold all points, the points of a batch have equally many
    bodies: with fewer bodies than the others, a point would carry bodies that it does not have.
    """
    groups: dict[Hashable, list[Point]] = {}
    for point in system.points:
        scenario = point.scenario
        key: Hashable = point.name
        if isinstance(scenario, TrackScenario):
            n_bodies = 0
            if len(system.points) > size:
                # A scenario has the same bodies at all times: time 0 suffices to count them.
                n_bodies = len(scenario.tracks(np.zeros((1, 1))))
            key = (
                scenario.vut_length,
                scenario.vut_width,
                scenario.sensor_setback,
                n_bodies,
                scenario.network,
            )
        groups.setdefault(key, []).append(point)
    for group in groups.values():
        group.sort(key=lambda point: point.scenario.duration)
        for start in range(0, len(group), size):
            yield tuple(group[start : start + size])
