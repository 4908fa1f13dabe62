"""Encounters of a study that searches its scenario: each setting has values of its own for some
parameters of scenario and weather.

A scenario whose parameters are arrays of N values stands for N scenarios. Its scene is a recorded
one, in which each vehicle starts elsewhere and meets a target that moves otherwise
(`Scenario.layout`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from msgspec.structs import replace as replace_fields

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.records import Quantity
from safevar_sumo.scenarios import (
    VUT,
    WEATHER_PARAMETERS,
    Point,
    Simulator,
    TrackScenario,
    WorldScenario,
    searchable_in,
)
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.study import PHASE, Study, unit_text
from safevar_sumo.sumo.bodies import Film
from safevar_sumo.sumo.network import networks_for
from safevar_sumo.sumo.recording import Recording


def check_domains(study: Study, points: tuple[Point, ...]) -> None:
    """Refuse a searched parameter that a scenario of the study does not have or in which weathers
    of its matrix differ, a domain that is wider than the scenario's, and domains in which an
    encounter is impossible.
    """
    # What the scenarios at all points let vary, in their units and domains.
    for point in points:
        legal = searchable_in(point.scenario)
        for name, domain in study.scenario.search.items():
            key = f"scenario.search.{name}"
            where = f"{key}: {point.name} of [matrix]: " if point.name else f"{key}: "
            problem = f"{where}{type(point.scenario).__name__} has no such parameter to search"
            check_name("", problem, name, legal)
            widest = legal[name]
            if widest.unit and domain.unit != widest.unit:
                raise InputError("", f"{key}.unit = {domain.unit!r}", repr(widest.unit))
            if domain.lower < widest.lower or domain.upper > widest.upper:
                problem = f"{key}: lower = {domain.lower:g} and upper = {domain.upper:g}"
                part = f"[{widest.lower:g}, {widest.upper:g}]{unit_text(widest.unit)}"
                raise InputError("", problem, f"a part of {part}")
            first = points[0].weather
            other = point.weather
            if name in WEATHER_PARAMETERS and getattr(first, name) != getattr(other, name):
                problem = (
                    f"{key}: weathers {first.name} and {other.name} of the matrix set {name}, too"
                )
                raise InputError("", problem, "a domain, or values in the weathers")

    # An encounter at every corner of the domains is possible.
    ends = [(domain.lower, domain.upper) for domain in study.scenario.search.values()]
    corners = [dict(zip(study.scenario.search, corner, strict=True)) for corner in product(*ends)]
    corners = [
        corner
        for corner in corners
        if all(constraint.allows(corner) for constraint in study.constraints)
    ]
    for point in points:
        try:
            scenarios = [encounter(point, corner).scenario for corner in corners]
            if not isinstance(scenarios[0], Simulator):
                networks_for(scenarios)
            for scenario in scenarios:
                if isinstance(scenario, TrackScenario):
                    scenario.tracks(np.zeros((1, 1)))
        except InputError as error:
            raise InputError(
                "", f"scenario.search: {error.problem}", error.legal or "narrower domains"
            ) from None


def encounter(point: Point, values: Mapping[str, Quantity]) -> Point:
    """A point at other values of parameters, numbers, or arrays for N vehicles; its scenario is the
    same object if only weather and phase vary.
    """
    values = dict(values)
    phase = values.pop(PHASE, point.phase) if point.scenario.has_phase else point.phase
    of_weather = {name: value for name, value in values.items() if name in WEATHER_PARAMETERS}
    of_scenario = {name: value for name, value in values.items() if name not in of_weather}
    weather = replace_fields(point.weather, **of_weather)
    scenario = point.scenario.at(of_scenario) if of_scenario else point.scenario
    return point._replace(scenario=scenario, weather=weather, phase=phase)


def scenes_of_encounters(recording: Recording, scenario: WorldScenario, n: int) -> Recording:
    """The scenes of N vehicles whose scenario has arrays as parameters, from a recorded scene."""
    # The scene up to the longest encounter.
    samples = 1 + int(np.max(np.round(np.asarray(scenario.duration) / recording.step_length)))
    layout = scenario.layout(recording, recording.step_length, samples)
    tracks = {name: _extended(track, samples) for name, track in recording.tracks.items()}

    # A pedestrian walks as in each encounter.
    if layout.pedestrian:
        track = recording.tracks[layout.pedestrian]
        frame = Frame.of(recording.lane(recording.first_lanes[VUT]))
        at_lane = np.nanargmin(np.abs(frame.left(track.motion[:, :2])))
        place = frame.point(frame.along(track.motion[[at_lane], :2]), layout.left)
        sign = np.where(layout.backwards, -1.0, 1.0)
        _, _, dir_x, dir_y, _ = track.motion[0]
        columns = np.broadcast_arrays(
            np.empty((samples, n)), *place, sign * dir_x, sign * dir_y, layout.speed
        )[1:]
        tracks[layout.pedestrian] = track._replace(motion=np.stack(columns, axis=-1))
    return replace(
        recording,
        start=np.broadcast_to(recording.start if layout.front is None else layout.front, n),
        speed=np.broadcast_to(recording.speed, n),
        tracks=tracks,
    )


def _extended(track: Film, samples: int) -> Film:
    """The track of an actor who stands, for at least this number of samples."""
    missing = max(samples - len(track.motion), 0)
    return track._replace(motion=np.pad(track.motion, ((0, missing), (0, 0)), mode="edge"))
