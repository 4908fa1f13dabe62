"""Encounters in ranges of parameters of scenario and weather: each setting has its own values of
these parameters, meets the tests whose ranges hold these values, and has the result of the worst
test that it meets.

A scenario whose parameters are arrays of N values stands for N scenarios. One recorded scene gives
the N scenes: each vehicle starts at another place, and meets a target that moves in another way
(`Scenario.layout`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_fields

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.metrics import IMPACT_EXCESS
from safevar_sumo.records import (
    BoolArray,
    Evaluations,
    FloatArray,
    IntArray,
    Outcome,
    Quantity,
)
from safevar_sumo.scenarios import (
    VUT,
    WEATHER_PARAMETERS,
    Point,
    TrackScenario,
    WorldScenario,
    searchable_in,
)
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.study import PHASE, Domain, Study, unit_text
from safevar_sumo.sumo.bodies import Film
from safevar_sumo.sumo.network import networks_for
from safevar_sumo.sumo.recording import Recording

if TYPE_CHECKING:
    from safevar_sumo.sumo.system import System


def check_domains(study: Study, points: tuple[Point, ...]) -> None:
    """Refuse ranges in which not every encounter can be simulated.

    Raises
    ------
    InputError
        If a test's scenario does not have a parameter with a range; if a range has another unit
        than the scenario's range, or is wider; if the weathers of the matrix set different values
        of a parameter with a range; or if an encounter at a corner of the ranges is impossible.
    """
    for point in points:
        legal = searchable_in(point.scenario)
        ranges = _ranges_of(point, study.ranges)
        kind = type(point.scenario).__name__
        if point.name:
            kind = f"{point.name} of [matrix]: {kind}"
        for name, domain in ranges.items():
            key = f"over.{name}"
            problem = f"{key}: {kind} has no such parameter to search"
            check_name("", problem, name, legal)
            widest = legal[name]
            if widest.unit and domain.unit != widest.unit:
                raise InputError("", f"{key}.unit = {domain.unit!r}", repr(widest.unit))
            if domain.lower < widest.lower or domain.upper > widest.upper:
                problem = (
                    f"{key}: lower = {domain.lower:g} and upper = {domain.upper:g}"
                )
                part = f"[{widest.lower:g}, {widest.upper:g}]{unit_text(widest.unit)}"
                raise InputError("", problem, f"a part of {part}")
            first_weather = points[0].weather
            weather = point.weather
            if name in WEATHER_PARAMETERS and getattr(first_weather, name) != getattr(
                weather, name
            ):
                weathers = f"{first_weather.name} and {weather.name}"
                raise InputError(
                    "",
                    f"{key}: weathers {weathers} of the matrix set {name}, too",
                    "a range, or values in the weathers",
                )
        _check_corners(study, point, ranges)


def _check_corners(study: Study, point: Point, ranges: Mapping[str, Domain]) -> None:
    """Refuse ranges of a point in which the encounter at a corner is impossible."""
    ends = [(domain.lower, domain.upper) for domain in ranges.values()]
    corners = [dict(zip(ranges, corner, strict=True)) for corner in product(*ends)]
    constraints = (*study.shared_constraints, *point.constraints)
    for constraint in constraints:
        corners = [corner for corner in corners if constraint.allows(corner)]
    try:
        scenarios = [encounter(point, corner).scenario for corner in corners]
        if scenarios and scenarios[0].mover.has("roads"):
            networks_for(scenarios)
        for scenario in scenarios:
            if isinstance(scenario, TrackScenario):
                scenario.tracks(np.zeros((1, 1)))
    except InputError as error:
        raise InputError(
            "", f"over: {error.problem}", error.legal or "narrower ranges"
        ) from None


def encounter(point: Point, values: Mapping[str, Quantity]) -> Point:
    """The point with other values of those parameters that it has. A value is a number, or an array
    of shape (N,) for N vehicles.

    If the values are of weather and phase alone, the new point has the same scenario object.
    """
    values = point.own(values)
    phase = point.phase
    if point.scenario.has_phase:
        phase = values.pop(PHASE, phase)
    names = WEATHER_PARAMETERS.keys() & values.keys()
    weather_values = {name: values.pop(name) for name in names}
    weather = replace_fields(point.weather, **weather_values)
    scenario = point.scenario
    if values:
        scenario = scenario.at(values)
    return point._replace(scenario=scenario, weather=weather, phase=phase)


def original_encounter(point: Point, ranges: Mapping[str, Domain]) -> Point:
    """The point with the original value of each parameter that has a range. The ranges are those of
    the point's test; `ranges` (those of the study) if the point states none.
    """
    return encounter(point, _originals(_ranges_of(point, ranges)))


def _ranges_of(point: Point, ranges: Mapping[str, Domain]) -> Mapping[str, Domain]:
    """The ranges of the point's test; `ranges` (those of the study) if the point states none."""
    if point.ranges is None:
        return ranges
    return point.ranges


def _originals(ranges: Mapping[str, Domain]) -> dict[str, Quantity]:
    return {name: domain.original for name, domain in ranges.items()}


def scenes_of_encounters(
    recording: Recording, scenario: WorldScenario, n: int
) -> Recording:
    """The scenes of N vehicles, made from one recorded scene. Parameters of the scenario are arrays
    of shape (N,).
    """
    step = recording.step_length
    samples = 1 + int(np.max(np.round(np.asarray(scenario.duration) / step)))
    layout = scenario.layout(recording, step, samples)
    tracks = {}
    for name, track in recording.tracks.items():
        tracks[name] = _extended(track, samples)

    if layout.pedestrian:
        track = recording.tracks[layout.pedestrian]
        frame = Frame.of(recording.lane(recording.first_lanes[VUT]))
        # The index of the recorded sample at which the pedestrian is nearest to the middle of the
        # lane. Positions are NaN in samples in which the pedestrian is not on the road.
        nearest_sample = np.nanargmin(np.abs(frame.left(track.motion[:, :2])))
        # `along` takes an array of positions: x and y of this sample alone have shape (1, 2).
        place = frame.point(
            frame.along(track.motion[[nearest_sample], :2]), layout.left
        )
        sign = np.where(layout.backwards, -1.0, 1.0)
        _, _, dir_x, dir_y, _ = track.motion[0]
        motion = *place, sign * dir_x, sign * dir_y, layout.speed
        columns = [np.broadcast_to(column, (samples, n)) for column in motion]
        tracks[layout.pedestrian] = track._replace(motion=np.stack(columns, axis=-1))
    start = layout.front
    if start is None:
        start = recording.start
    return replace(
        recording,
        start=np.broadcast_to(start, n),
        speed=np.broadcast_to(recording.speed, n),
        tracks=tracks,
    )


def _extended(track: Film, samples: int) -> Film:
    """The track with at least this number of samples: the actor then stays as in the last one."""
    shortage = max(samples - len(track.motion), 0)
    return track._replace(
        motion=np.pad(track.motion, ((0, shortage), (0, 0)), mode="edge")
    )


def where_met(system: System, setting: FloatArray) -> System:
    """The system with only those points that a setting, shape (n,), meets. A point that belongs to
    no test always stays.

    Raises
    ------
    InputError
        If the setting meets no point.
    """
    settings = setting[np.newaxis]
    points = tuple(
        point
        for point in system.points
        if not point.name or met_at(point, system, settings).all()
    )
    if not points:
        raise InputError(
            system.source,
            f"no test has the encounter of {system.characteristics.options(setting)}",
            "values in the ranges of one test",
        )
    return replace(system, points=points)


def met_at(point: Point, system: System, settings: FloatArray) -> BoolArray:
    """Which of N settings meet a point, shape (N,): the setting's encounter is in the ranges of the
    point, and satisfies the point's constraints.

    A value beyond the range of the study counts as the end of this range.
    """
    members = system.characteristics.scenario
    # `split` returns the vehicles and then the encounters, shape (N, n - k).
    encounters = np.clip(system.split(settings)[1], members.lower, members.upper)
    return np.broadcast_to(point.meets(members.columns(encounters)), len(settings))


def in_place_of_unmet(
    point: Point, system: System, settings: FloatArray, is_met: BoolArray
) -> FloatArray:
    """The settings, shape (N, n). Settings that do not meet the point (`is_met`, shape (N,), is
    false) get the point's original encounter, so that all settings can be simulated together.
    """
    members = system.characteristics
    originals = _originals(point.ranges or {})
    original = np.array([originals.get(item.name, item.original) for item in members])
    return np.where(is_met[:, np.newaxis] | members.of_vehicle, settings, original)


def worst_points(
    system: System, evaluations_by_point: Sequence[Evaluations]
) -> IntArray:
    """The index of each setting's worst point in `system.points`, shape (N,).
    `evaluations_by_point` has the evaluations of the N settings at each point, in the order of the
    points.

    - By the aggregate "worst" of the matrix, the point with the least safety degree is the worst.
    - By another aggregate, such as "drac >", the worst value of this metric decides for a setting
      that collides at no point. For a setting that collides, the least safety degree decides. The
      metric `impact_excess` is an exception: this metric decides for every setting.
    - Of a setting without a collision, a point with an invalid test is the worst, because such a
      test leaves open whether the setting is safe.
    - Of equal points, the first by name is the worst.
    """
    # With points sorted by name, ties do not depend on the order of tests in the study's file.
    order = np.argsort([point.name for point in system.points])
    evaluations = Evaluations.concatenate([evaluations_by_point[k] for k in order])
    shape = (len(order), -1)
    safety_degrees = evaluations.f_safe.reshape(shape)
    safety_degrees = np.where(np.isnan(safety_degrees), np.inf, safety_degrees)
    is_invalid = (evaluations.outcome == Outcome.INVALID_TEST).reshape(shape)
    has_collided = evaluations.collided.reshape(shape).any(axis=0)
    values = safety_degrees

    if system.deciding:
        name, largest_is_worst = system.deciding
        measures = evaluations.column(name).reshape(shape)
        if largest_is_worst:
            measures = -measures
        measures = np.where(np.isnan(measures), np.inf, measures)
        # A test may allow impacts: then only the excess says how bad a collision is.
        values = np.where(
            ~has_collided | (name == IMPACT_EXCESS.name), measures, safety_degrees
        )

    values[is_invalid & ~has_collided] = -np.inf
    return np.asarray(order[np.argmin(values, axis=0)])
