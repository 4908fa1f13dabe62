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
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.target_observer import TargetObserver
from safevar_sumo.sumo.world import begin

OCCLUDED_VALUES = np.array([[np.inf], [np.inf], [0.0], [0.0]])
"""Gap and lateral position [m], lateral speed and speed [m/s] of an occluded obstacle."""


class Perception:
    """Observations of N vehicles in one weather, step by step."""

    def __init__(self, weather: Weather, step: float) -> None:
        self._visibility, self._delay_line = weather.visibility, DelayLine.by(weather.recognition_delay, step)

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observation at this step; must be called in every step. An occluded obstacle appears at rest, infinitely
        far away.
        """
        values = np.empty((len(OCCLUDED_VALUES) + 1, len(speed)))
        values[0], values[1], values[2], values[3], values[4] = (
            scene.gap,
            scene.lateral,
            scene.lateral_speed,
            scene.obstacle_speed,
            speed,
        )
        if scene.visible is not ALL_TRUE:
            values[:-1] = np.where(scene.visible, values[:-1], OCCLUDED_VALUES)
        (gap, lateral, lateral_speed, obstacle_speed, old_speed), self._delay_line = self._delay_line.delayed(values)
        return Observation(
            time, speed, gap, old_speed - obstacle_speed, lateral, lateral_speed, self._visibility, obstacle_speed
        )


RecordT = TypeVar("RecordT", Scene, Observation)


class PointBatch:
    """A batch of K groups of vehicles, all of the same size; group k drives in the scenario and weather of point k."""

    def __init__(self, points: Sequence[Point], world: Any, n: int) -> None:
        self._group_size = size = n // len(points)
        self._points, self._step = points, world.step_length
        self._groups = [slice(k * size, (k + 1) * size) for k in range(len(points))]
        self._is_recorded, self._scenes, self._memories = isinstance(world, RecordedWorld), list[Scene](), list[Any]()
        self._worlds = world.slices if self._is_recorded else [world]
        weathers = [point.weather for point in points]
        self._perceptions = [
            (Perception(weather, self._step), np.repeat([other == weather for other in weathers], size).nonzero()[0])
            for k, weather in enumerate(weathers)
            if weather not in weathers[:k]
        ]
        self._vehicle_order = np.argsort(np.concatenate([vehicles for _, vehicles in self._perceptions]))
        self.last_step = np.repeat([round(point.scenario.duration / self._step) for point in points], size)
        self._target_observer = (
            TargetObserver.of([point.scenario for point in points], world, size) if self._is_recorded else None
        )
        if self._target_observer is None:
            self._memories = [
                begin(point.scenario, scenario_world)
                for point, scenario_world in zip(points, self._worlds, strict=True)
            ]

    def scene(self, is_open: BoolArray) -> Scene:
        """The scene of all vehicles now; in recorded scenes, a group whose runs have all ended keeps its last scene."""
        if self._target_observer is not None:
            return self._target_observer.observe(is_open)
        for k, (point, world) in enumerate(zip(self._points, self._worlds, strict=True)):
            if not self._is_recorded or k >= len(self._scenes) or np.count_nonzero(is_open[self._groups[k]]):
                scene, self._memories[k] = point.scenario.observe(world, self._step, self._memories[k])
                self._scenes[k : k + 1] = [scene]
        return (
            self._scenes[0] if len(self._scenes) == 1 else _join(self._scenes, [self._group_size] * len(self._scenes))
        )

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        if len(self._perceptions) == 1:
            ((perception, _),) = self._perceptions
            return perception.observe(time, speed, scene)
        observations = [
            perception.observe(
                time, speed[vehicles], Scene._make(values[vehicles] if values.ndim else values for values in scene)
            )
            for perception, vehicles in self._perceptions
        ]
        joined = _join(observations, [len(vehicles) for _, vehicles in self._perceptions])
        return Observation._make(
            np.asarray(values)[self._vehicle_order] if np.ndim(values) else values for values in joined
        )

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry of all encounters, from which the metrics are computed."""
        if len(self._points) == 1:
            return self._points[0].scenario.encounter(trace)
        encounters = [
            point.scenario.encounter(trace.of(group)) for point, group in zip(self._points, self._groups, strict=True)
        ]
        return Encounter(*(np.concatenate(columns, axis=1) for columns in zip(*encounters, strict=True)))


def _join(records: Sequence[RecordT], sizes: Sequence[int]) -> RecordT:
    """Join records of scalars or arrays of shape (size,) into a record of longer arrays; a scalar that all share stays
    a scalar.
    """
    return type(records[0])._make(_concatenate(column, sizes) for column in zip(*records, strict=True))


def _concatenate(columns: Sequence[Any], sizes: Sequence[int]) -> Any:
    if np.ndim(columns[0]) == 0 and all(column is columns[0] for column in columns):
        return columns[0]
    return np.concatenate(
        [column if np.ndim(column) else np.full(size, column) for column, size in zip(columns, sizes, strict=True)]
    )
