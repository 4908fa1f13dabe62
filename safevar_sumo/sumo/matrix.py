"""Settings at the points of a study: at its one scenario, or at all of a matrix, where the worst point counts."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import fields, replace
from difflib import SequenceMatcher
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.protocol import part_of
from safevar_sumo.protocol.rater import cell_columns, in_some_cells, joined_cells
from safevar_sumo.records import CellResults, Contact, Encounter, Evaluations, FloatArray, Outcome, SimulationRuns, Trace
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.euro_ncap import KMH
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.batch import Watcher, drive_all, reason_for_sumo, score, step_options
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.network import lanes_of
from safevar_sumo.sumo.recording import Recording, recorded_scenes
from safevar_sumo.sumo.system import System, assemble

LARGEST_WORLD = 200
"""Copies of a network in one simulation; more cost more each, as SUMO then works beyond the processor's caches."""
LARGEST_BATCH = 2000
"""Vehicles in recorded scenes at once; two hundred steps of so many take some 100 MB."""
LARGEST_ROADS = 100_000
"""Lanes of all copies in one simulation: beyond, loading takes minutes and gigabytes."""
NEAREST = 4
"""Points that are told to who names one that there is not."""


class Scored(NamedTuple):
    """What N settings are worth at one point of a study."""

    point: Point
    evaluations: Evaluations


class AtPoint(NamedTuple):
    """N settings at one point of a study."""

    point: Point
    evaluations: Evaluations
    drives: SimulationRuns


def point_record(result: AtPoint, row: int = 0) -> dict[str, Any]:
    """One setting at one point as plain values: where that is, how it ended, speeds of the impact [m/s], the worst deviation from the
    test's speed before the system acted [km/h], the time to collision at the first warning [s], who was touched where [%]; None if
    undefined.
    """
    evaluations, relative = result.evaluations, result.drives.relative_speed
    numbers = {"impact_speed": evaluations.collision_speed[row], "relative_impact_speed": relative[row],
               SAFETY_DEGREE: evaluations.f_safe[row],
               "test_speed_error": np.broadcast_to(result.drives.test_speed_error, relative.shape)[row] / KMH,
               "warning_ttc": np.broadcast_to(result.drives.warning_ttc, relative.shape)[row]}
    side, place = (np.broadcast_to(values, relative.shape)[row] for values in result.drives.contact)
    return {"point": result.point.name, **dict(result.point.place), "outcome": str(evaluations.outcome[row]),
            **{name: None if np.isnan(value) else float(value) for name, value in numbers.items()},
            **({"contact": {"side": str(side), "place": float(place)}} if side else {})}


def remarks_of(scenario: Any) -> list[str]:
    """What a user should know of a scenario's parameters."""
    remarks = getattr(scenario, "remarks", None)
    return [] if remarks is None else remarks()


def vehicle_remarks(system: System) -> list[str]:
    """What a user should know of a vehicle that is tested faster than what it was fitted to."""
    fitted = getattr(system.vehicle, "FITTED_UP_TO", None)
    speeds = [getattr(point.scenario, "test_speed", None) or 0.0 for point in system.points]
    if fitted is None or max(speeds) <= fitted:
        return []
    tables = system.nominal.tables()
    fastest = min(max(speeds), float(tables.speeds[-1]))
    drag = float(np.interp(fastest, tables.speeds, tables.coasting))
    return [f"the vehicle was fitted to drives of up to {fitted / KMH:.0f} km/h, and is tested at up to {max(speeds) / KMH:.0f} km/h: "
            f"what it does above is its equations alone, such as losing {drag:.1f} m/s^2 at {fastest / KMH:.0f} km/h with the "
            "accelerator released"]


def evaluate(system: System, settings: FloatArray, engine: Engine = Engine.RECORDED) -> Evaluations:
    """Simulate filtered settings, shape (N, n), in one batch and score them.

    A pure function: row i of the result depends on row i of `settings` alone, to the bit. In a matrix a setting's row is that
    of the point in which it comes off worst.
    """
    most = _most_vehicles(system, engine)
    parts = [settings[first:first + most] for first in range(0, len(settings), most)] or [settings]
    evaluations = [_evaluated(system, part, engine) for part in parts]
    return evaluations[0] if len(evaluations) == 1 else Evaluations.concatenate(evaluations)


def _evaluated(system: System, settings: FloatArray, engine: Engine) -> Evaluations:
    if system.rater is not None:
        return rated_settings(system, settings, engine)[0]
    if system.matrix:
        return aggregated(at_every_point(system, settings, engine))
    return score(system, settings, simulate(system, settings, engine))


def rated_settings(system: System, settings: FloatArray, engine: Engine = Engine.RECORDED) -> tuple[Evaluations, CellResults]:
    """Settings, shape (N, n), in all cells of a protocol: what they are worth, with their points, and what they did in every cell.

    Nothing else of the simulations is kept: their traces would take gigabytes.
    """
    scored, columns = dict[str, Scored](), dict[str, Any]()
    for group in _groups(system, settings, engine):
        for one in group:
            scored[one.point.name], columns[one.point.name] = Scored(one.point, one.evaluations), cell_columns(one.drives)
    cells = joined_cells([columns[point.name] for point in system.points])
    evaluations = aggregated([scored[point.name] for point in system.points])
    if system.rater is None:  # in some of the cells
        return evaluations, cells
    return replace(evaluations, metrics={**evaluations.metrics, RATING_POINTS.name: system.rater.points(cells).total}), cells


def in_cells(system: System, settings: FloatArray, part: tuple[int, int], engine: Engine = Engine.RECORDED) -> Evaluations:
    """Settings, shape (N, n), in the k-th of n parts of a protocol's cells, `part` being (k, n): evaluations with their `cells`."""
    assert system.rater is not None
    points = tuple(system.matrix[number] for number in part_of(system.rater.protocol, *part))
    evaluations, cells = rated_settings(replace(system, matrix=points, rater=None), settings, engine)
    return replace(evaluations, cells=cells)


def settings_per_batch(system: System, engine: Engine) -> int:
    """How many settings a batch pays to have."""
    recorded = engine is Engine.RECORDED and not reason_for_sumo(system)
    return max(largest_batch(system) // len(system.points), LARGEST_WORLD) if recorded else LARGEST_WORLD


def largest_batch(system: System) -> int:
    """How many vehicles drive at once: fewer where each has an instance of an FMU."""
    return min(LARGEST_BATCH, *(getattr(model, "most_vehicles", LARGEST_BATCH) for model in (system.vehicle, system.ads)))


def _most_vehicles(system: System, engine: Engine) -> int:
    """How many vehicles one simulation may have: in a recorded scene, or in copies of the largest of the networks."""
    if engine is Engine.RECORDED and not reason_for_sumo(system):
        return largest_batch(system)
    lanes = max(lanes_of(network) for network in {point.scenario.network for point in system.points})
    return min(max(LARGEST_ROADS // max(lanes, 1), 1), LARGEST_WORLD, largest_batch(system))


def aggregated(at_points: Sequence[AtPoint | Scored]) -> Evaluations:
    """What settings that were simulated at every point are worth."""
    settings = at_points[0].evaluations.settings
    row_of, columns = worst_points(at_points), np.arange(len(settings))
    every = Evaluations.concatenate([one.evaluations for one in at_points])
    return every.take(row_of * len(settings) + columns)


def simulate(system: System, settings: FloatArray, engine: Engine = Engine.RECORDED, options: tuple[str, ...] = (),
             watch: Watcher | None = None) -> SimulationRuns:
    """Run the scenario once for every setting; shape (N, n). `watch` is shown the world at every sample.

    In a matrix a setting's drive is that of the point in which it comes off worst; who watches sees all settings at the
    point in which the last of them does.

    Raises
    ------
    SimulationError
        If SUMO fails.
    InputError
        If a user's ADS fails.
    """
    if not system.matrix:
        return drive_all(system, settings, engine, options, watch)
    if watch is not None or engine is Engine.GUI:
        return drive_all(at_worst(system, settings), settings, engine, options, watch)
    at_points = at_every_point(system, settings, engine, options)
    return _picked([one.drives for one in at_points], worst_points(at_points))


def at_every_point(system: System, settings: FloatArray, engine: Engine = Engine.RECORDED, options: tuple[str, ...] = ()) -> list[AtPoint]:
    """Settings, shape (N, n), at every point, in the points' order; raises as `simulate`."""
    by_name = {one.point.name: one for group in _groups(system, settings, engine, options) for one in group}
    return [by_name[point.name] for point in system.points]


def _groups(system: System, settings: FloatArray, engine: Engine, options: tuple[str, ...] = ()) -> Iterator[list[AtPoint]]:
    """Settings at every point, group by group of the points that are simulated together."""
    n = len(settings)
    recorded = engine is Engine.RECORDED and not reason_for_sumo(system)
    most, all_options = largest_batch(system) // max(n, 1), (*step_options(system), *options)
    for points in _together(system.points, most, all_options) if recorded else ((point,) for point in system.points):
        drives = drive_all(replace(system, matrix=points), settings, engine, options)
        evaluations = score(system, np.tile(settings, (len(points), 1)), drives)
        parts = [slice(k * n, (k + 1) * n) for k in range(len(points))]
        yield [AtPoint(point, evaluations.take(np.arange(rows.start, rows.stop)), drives.of(rows))
               for point, rows in zip(points, parts, strict=True)]


def at_worst(system: System, settings: FloatArray) -> System:
    """The system at the one point in which the last of the settings comes off worst."""
    if not system.matrix:
        return system
    return system.at(system.points[worst_points(at_every_point(system, settings[-1:]))[0]])


def named_point(system: System, name: str, source: object) -> System:
    """The system at the point of a matrix that is named.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    for point in system.matrix:
        if point.name == name:
            return system.at(point)
    raise InputError(source, repr(name), _nearest(name, [point.name for point in system.matrix]))


def _nearest(name: str, names: Sequence[str]) -> str:
    """What is legal in the place of a name: those that have most of its parts, the most alike first."""
    if not names:
        return "a study with a matrix"
    asked = {part.strip() for part in name.split(",")}
    order = sorted(names, key=lambda one: (-len(asked & set(one.split(", "))), -SequenceMatcher(None, one, name).ratio()))
    legal = "; ".join(order[:NEAREST])
    return legal if len(names) <= NEAREST else f"one of {len(names)} points, the nearest of them: {legal}"


def study_at(study: Study, name: str, source: object) -> Study:
    """A study with the one point of its matrix that is named; raises as `named_point`."""
    system = assemble(study)
    named_point(system, name, source)
    assert study.matrix is not None
    if system.rater is not None:
        return in_some_cells(study, system.weather, [next(k for k, point in enumerate(system.matrix) if point.name == name)])
    place = dict(next(point for point in system.matrix if point.name == name).place)
    title, weather = place.pop("test"), place.pop("weather")
    test = next(one for one in study.matrix.tests
                if one.name == title and one.over.keys() == place.keys() and all(value in one.over[key] for key, value in place.items()))
    only = replace_in(test, over={key: [value] for key, value in place.items()}, weathers=[weather] if test.weathers else [])
    return replace_in(study, matrix=replace_in(study.matrix, tests=[only]))


def _together(points: Sequence[Point], most: int, options: Sequence[str]) -> Iterator[tuple[Point, ...]]:
    """Points with recorded scenes of one road, as many as one simulation may have; those of short runs first."""
    groups: dict[Hashable, list[Point]] = {}
    for point, scene in zip(points, recorded_scenes([point.scenario for point in points], options), strict=True):
        groups.setdefault(scene.road if isinstance(scene, Recording) else "", []).append(point)
    for group in groups.values():
        group.sort(key=lambda point: point.scenario.duration)
        for start in range(0, len(group), max(most, 1)):
            yield tuple(group[start:start + max(most, 1)])


def worst_points(at_points: Sequence[AtPoint | Scored]) -> npt.NDArray[np.intp]:
    """For every setting the number of the point with the least safety degree; among equals the first by name.

    A collision at a valid point stands, whatever the others are. Without one, a single invalid test makes it unknown whether the
    setting is safe: then that point counts.
    """
    order = sorted(range(len(at_points)), key=lambda k: at_points[k].point.name)
    degrees = np.stack([at_points[k].evaluations.f_safe for k in order])
    degrees = np.where(np.isnan(degrees), np.inf, degrees)
    invalid = np.stack([at_points[k].evaluations.outcome == Outcome.INVALID_TEST for k in order])
    if invalid.any():
        collided = np.stack([at_points[k].evaluations.collided for k in order]).any(axis=0)
        degrees = np.where(invalid & ~collided, -np.inf, degrees)
    return np.asarray(np.array(order)[np.argmin(degrees, axis=0)])


def _picked(drives: Sequence[SimulationRuns], number: npt.NDArray[np.intp]) -> SimulationRuns:
    """For every vehicle its drive among several; shorter ones stay at their last sample, where nothing counts any more."""
    length, columns = max(len(one.trace.time) for one in drives), np.arange(len(number))

    def picked(values: list[np.ndarray]) -> np.ndarray:
        whole = [np.concatenate([one, np.repeat(one[-1:], length - len(one), axis=0)]) for one in values]
        return np.stack(whole)[number, :, columns].T

    longest = max((one.trace for one in drives), key=lambda trace: len(trace.time))
    def of_each(values: list[np.ndarray]) -> np.ndarray:
        return np.stack([np.broadcast_to(one, number.shape) for one in values])[number, columns]

    names = [one.name for one in fields(Trace) if np.ndim(getattr(longest, one.name)) == 2]
    columns_of: dict[str, Any] = {name: picked([getattr(one.trace, name) for one in drives]) for name in names}
    trace = replace(longest, **columns_of)
    ended = np.array([len(one.trace.time) for one in drives])[number]
    active = trace.active & (np.arange(length)[:, np.newaxis] < ended)
    encounters = zip(*(one.encounter for one in drives), strict=True)
    return SimulationRuns(
        trace=replace(trace, active=active), encounter=Encounter._make(picked(list(values)) for values in encounters),
        outcome=of_each([one.outcome for one in drives]), collision_speed=of_each([one.collision_speed for one in drives]),
        contact=Contact._make(of_each(list(values)) for values in zip(*(one.contact for one in drives), strict=True)),
        test_speed_error=of_each([one.test_speed_error for one in drives]), warning_ttc=of_each([one.warning_ttc for one in drives]))
