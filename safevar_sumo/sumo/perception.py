"""Observations of an ADS: its own speed without delay, everything else with the recognition delay of the weather."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from safevar_sumo.ads.driver import DelayLine
from safevar_sumo.records import EVERYWHERE, BoolArray, Encounter, FloatArray, Observation, Trace
from safevar_sumo.scenarios import Point
from safevar_sumo.scenarios.base import Scene
from safevar_sumo.study import Weather
from safevar_sumo.sumo.meetings import Meetings
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.world import begin

HIDDEN = np.array([[np.inf], [np.inf], [0.0], [0.0]])
"""Gap and lateral position [m], lateral speed and speed [m/s] of an occluded obstacle."""


class Perception:
    """Observations of N vehicles in one weather, one step after the other."""

    def __init__(self, weather: Weather, step: float) -> None:
        self._visibility, self._delay_line = weather.visibility, DelayLine.by(weather.recognition_delay, step)

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observation at this step; must be called in every step. An occluded obstacle is infinitely far away and still."""
        now = np.empty((len(HIDDEN) + 1, len(speed)))
        now[0], now[1], now[2], now[3], now[4] = scene.gap, scene.lateral, scene.lateral_speed, scene.obstacle_speed, speed
        if scene.visible is not EVERYWHERE:
            now[:-1] = np.where(scene.visible, now[:-1], HIDDEN)
        (gap, lateral, lateral_speed, obstacle_speed, own), self._delay_line = self._delay_line.delayed(now)
        return Observation(time, speed, gap, own - obstacle_speed, lateral, lateral_speed, self._visibility, obstacle_speed)


R = TypeVar("R", Scene, Observation)


class PointBatch:
    """A batch of vehicles in equal parts, the k-th with the scenario and weather of the k-th point."""

    def __init__(self, points: Sequence[Point], world: Any, n: int) -> None:
        self._size = size = n // len(points)
        self._points, self._step = points, world.step_length
        self._rows = [slice(k * size, (k + 1) * size) for k in range(len(points))]
        self._recorded, self._scenes, self._memories = isinstance(world, RecordedWorld), list[Scene](), list[Any]()
        self._worlds = world.scenes if self._recorded else [world]
        weathers = [point.weather for point in points]
        self._perceptions = [(Perception(weather, self._step), np.repeat([other == weather for other in weathers], size).nonzero()[0])
                             for k, weather in enumerate(weathers) if weather not in weathers[:k]]
        self._order = np.argsort(np.concatenate([rows for _, rows in self._perceptions]))
        self.last_step = np.repeat([round(point.scenario.duration / self._step) for point in points], size)
        self._meetings = Meetings.of([point.scenario for point in points], world, size) if self._recorded else None
        if self._meetings is None:
            self._memories = [begin(point.scenario, one) for point, one in zip(points, self._worlds, strict=True)]

    def scene(self, open_: BoolArray) -> Scene:
        """The scene of all vehicles now; a recorded scene whose vehicles have all ended stays as it is."""
        if self._meetings is not None:
            return self._meetings.scene(open_)
        for k, (point, world) in enumerate(zip(self._points, self._worlds, strict=True)):
            if not self._recorded or k >= len(self._scenes) or np.count_nonzero(open_[self._rows[k]]):
                scene, self._memories[k] = point.scenario.observe(world, self._step, self._memories[k])
                self._scenes[k:k + 1] = [scene]
        return self._scenes[0] if len(self._scenes) == 1 else _joined(self._scenes, [self._size] * len(self._scenes))

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observations of all vehicles."""
        if len(self._perceptions) == 1:
            return self._perceptions[0][0].observe(time, speed, scene)
        observations = [perception.observe(time, speed[rows], Scene._make(values[rows] if values.ndim else values for values in scene))
                        for perception, rows in self._perceptions]
        joined = _joined(observations, [len(rows) for _, rows in self._perceptions])
        return Observation._make(np.asarray(values)[self._order] if np.ndim(values) else values for values in joined)

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry that the metrics are computed from."""
        if len(self._points) == 1:
            return self._points[0].scenario.encounter(trace)
        parts = [point.scenario.encounter(trace.of(rows)) for point, rows in zip(self._points, self._rows, strict=True)]
        return Encounter(*(np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)))


def _joined(records: Sequence[R], sizes: Sequence[int]) -> R:
    """Several records with arrays of shape (size,) or scalars as one record of longer arrays; shared scalars stay scalars."""
    return type(records[0])._make(_concatenated(column, sizes) for column in zip(*records, strict=True))


def _concatenated(parts: Sequence[Any], sizes: Sequence[int]) -> Any:
    if np.ndim(parts[0]) == 0 and all(part is parts[0] for part in parts):
        return parts[0]
    return np.concatenate([part if np.ndim(part) else np.full(size, part) for part, size in zip(parts, sizes, strict=True)])
