"""What an ADS observes: its own speed without delay, and everything else with the recognition delay of the weather."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from safevar_sumo.ads.driver import DelayLine
from safevar_sumo.records import ALL_TRUE, BoolArray, Encounter, FloatArray, Observation, Trace
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.base import Scene
from safevar_sumo.study import Weather
from safevar_sumo.sumo.meetings import Meetings
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.world import begin

OCCLUDED_VALUES = np.array([[np.inf], [np.inf], [0.0], [0.0]])
"""Gap and lateral position [m], lateral speed and speed [m/s] of an occluded obstacle."""


class Perception:
    """Observations of N vehicles in one weather, step by step."""

    def __init__(self, weather: Weather, step: float) -> None:
        self._visibility, self._delay_line = weather.visibility, DelayLine.by(weather.recognition_delay, step)

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observation at this step; must be called in every step. An occluded obstacle appears at rest, infinitely far away."""
        values = np.empty((len(OCCLUDED_VALUES) + 1, len(speed)))
        values[0], values[1], values[2], values[3], values[4] = scene.gap, scene.lateral, scene.lateral_speed, scene.obstacle_speed, speed
        if scene.visible is not ALL_TRUE:
            values[:-1] = np.where(scene.visible, values[:-1], OCCLUDED_VALUES)
        (gap, lateral, lateral_speed, obstacle_speed, old_speed), self._delay_line = self._delay_line.delayed(values)
        return Observation(time, speed, gap, old_speed - obstacle_speed, lateral, lateral_speed, self._visibility, obstacle_speed)


RecordT = TypeVar("RecordT", Scene, Observation)


class PointBatch:
    """A batch of vehicles in K equal parts; part k drives in the scenario and weather of point k."""

    def __init__(self, points: Sequence[Point], world: Any, n: int) -> None:
        self._size = size = n // len(points)
        self._points, self._step = points, world.step_length
        self._rows = [slice(k * size, (k + 1) * size) for k in range(len(points))]
        self._is_recorded, self._scenes, self._memories = isinstance(world, RecordedWorld), list[Scene](), list[Any]()
        self._worlds = world.scenes if self._is_recorded else [world]
        weathers = [point.weather for point in points]
        self._perceptions = [(Perception(weather, self._step), np.repeat([other == weather for other in weathers], size).nonzero()[0])
                             for k, weather in enumerate(weathers) if weather not in weathers[:k]]
        self._order = np.argsort(np.concatenate([rows for _, rows in self._perceptions]))
        self.last_step = np.repeat([round(point.scenario.duration / self._step) for point in points], size)
        self._meetings = Meetings.of([point.scenario for point in points], world, size) if self._is_recorded else None
        if self._meetings is None:
            self._memories = [begin(point.scenario, scenario_world) for point, scenario_world in zip(points, self._worlds, strict=True)]

    def scene(self, open_: BoolArray) -> Scene:
        """The scene of all vehicles now; a part of a recorded world whose runs have all ended keeps its last scene."""
        if self._meetings is not None:
            return self._meetings.observe(open_)
        for k, (point, world) in enumerate(zip(self._points, self._worlds, strict=True)):
            if not self._is_recorded or k >= len(self._scenes) or np.count_nonzero(open_[self._rows[k]]):
                scene, self._memories[k] = point.scenario.observe(world, self._step, self._memories[k])
                self._scenes[k:k + 1] = [scene]
        return self._scenes[0] if len(self._scenes) == 1 else _join(self._scenes, [self._size] * len(self._scenes))

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observations of all vehicles."""
        if len(self._perceptions) == 1:
            return self._perceptions[0][0].observe(time, speed, scene)
        observations = [perception.observe(time, speed[rows], Scene._make(values[rows] if values.ndim else values for values in scene))
                        for perception, rows in self._perceptions]
        joined = _join(observations, [len(rows) for _, rows in self._perceptions])
        return Observation._make(np.asarray(values)[self._order] if np.ndim(values) else values for values in joined)

    def encounter(self, trace: Trace) -> Encounter:
        """The encounters' geometry, from which the metrics are computed."""
        if len(self._points) == 1:
            return self._points[0].scenario.encounter(trace)
        parts = [point.scenario.encounter(trace.of(rows)) for point, rows in zip(self._points, self._rows, strict=True)]
        return Encounter(*(np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)))


def _join(records: Sequence[RecordT], sizes: Sequence[int]) -> RecordT:
    """Join records of scalars or arrays of shape (size,) into a record of longer arrays; a scalar that all share stays a scalar."""
    return type(records[0])._make(_concatenate(column, sizes) for column in zip(*records, strict=True))


def _concatenate(parts: Sequence[Any], sizes: Sequence[int]) -> Any:
    if np.ndim(parts[0]) == 0 and all(part is parts[0] for part in parts):
        return parts[0]
    return np.concatenate([part if np.ndim(part) else np.full(size, part) for part, size in zip(parts, sizes, strict=True)])
