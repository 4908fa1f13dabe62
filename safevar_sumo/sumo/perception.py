"""What ADSs observe: observations of the obstacle, delayed by the weather; and for controllers that read SUMO, the
traffic as the vehicle's sensors report it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from safevar_sumo.ads.base import DelayLine
from safevar_sumo.records import ALL_TRUE, BoolArray, Encounter, FloatArray, Observation, Trace
from safevar_sumo.scenarios import VUT, Point, Scenario, Scene
from safevar_sumo.scenarios.base import Frame, ScenarioMemory, World
from safevar_sumo.scenarios.target import EncounterConstants, Target, TargetTest, scene_of
from safevar_sumo.study import Weather
from safevar_sumo.sumo.recorded_world import DrivenWorld, RecordedWorld, SampledRecording, absence_error
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

    def __init__(self, points: Sequence[Point], world: DrivenWorld, n: int) -> None:
        self._group_size = size = n // len(points)
        self._points, self._step = points, world.step_length
        self._groups = [slice(k * size, (k + 1) * size) for k in range(len(points))]
        self._scenes, self._memories = list[Scene](), list[ScenarioMemory]()
        self._is_recorded, self._target_observer = isinstance(world, RecordedWorld), None
        self._worlds: Sequence[World]
        if isinstance(world, RecordedWorld):
            self._worlds = world.slices
            self._target_observer = TargetObserver.of([point.scenario for point in points], world, size)
        else:
            self._worlds = [world]
        weathers = [point.weather for point in points]
        self._perceptions = [
            (Perception(weather, self._step), np.repeat([other == weather for other in weathers], size).nonzero()[0])
            for k, weather in enumerate(weathers)
            if weather not in weathers[:k]
        ]
        self._vehicle_order = np.argsort(np.concatenate([vehicles for _, vehicles in self._perceptions]))
        self.last_step = np.repeat([round(point.scenario.duration / self._step) for point in points], size)
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


class TargetObserver:
    """Observes the targets of K recorded scenes with `size` vehicles each; `observe` must be called once per sample.

    Parameters
    ----------
    frame
        Frame of the lane that the vehicles are on.
    constants, targets
        Constants and targets of the K scenes; a target's columns have one row per sample.
    sampled_recordings
        The K recordings at all samples, which tell when a target is not on the road.
    """

    def __init__(
        self,
        frame: Frame,
        constants: Sequence[EncounterConstants],
        targets: Sequence[Target],
        sampled_recordings: Sequence[SampledRecording],
        world: RecordedWorld,
        size: int,
    ) -> None:
        self._frame, self._world, self._size, self._sampled_recordings = frame, world, size, sampled_recordings
        self._constants = EncounterConstants._make(
            _per_vehicle(column, size) for column in zip(*constants, strict=True)
        )
        length = max(len(target.edge) for target in targets)
        self._target = [_table(column, length) for column in zip(*targets, strict=True)]
        self._absence = _table([sampled.absence for sampled in sampled_recordings], length)
        self._sample, self._has_approached = 0, np.zeros(world.n, dtype=bool)

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], world: RecordedWorld, size: int) -> TargetObserver | None:
        """The observer of a world's scenes; None unless every scenario has a target that does not react, and all share
        one lane.
        """
        if not all(isinstance(scenario, TargetTest) for scenario in scenarios):
            return None
        sampled_recordings = [world_slice.at_all_samples() for world_slice in world.slices]
        motions, targets = zip(
            *(
                scenario.at_all_samples(*arguments, world.step_length)  # type: ignore[attr-defined]
                for scenario, *arguments in zip(scenarios, world.slices, sampled_recordings, strict=True)
            ),
            strict=True,
        )
        frames, constants = {motion.frame for motion in motions}, [motion.constants for motion in motions]
        return cls(frames.pop(), constants, targets, sampled_recordings, world, size) if len(frames) == 1 else None

    def observe(self, is_open: BoolArray) -> Scene:
        """The scene of all vehicles at the next sample; raises `SimulationError` if the target of an open run is not on
        the road.
        """
        sample, world = min(self._sample, len(self._absence) - 1), self._world
        if self._absence[sample].any():
            absent_scenes = np.flatnonzero(self._absence[sample] & is_open.reshape(-1, self._size).any(axis=1))
            if len(absent_scenes):
                raise absence_error(self._sampled_recordings[absent_scenes[0]].actor, self._sample * world.step_length)
        target = Target._make(
            column if column.ndim == 0 else column[sample].repeat(self._size) for column in self._target
        )
        front = self._frame.along(world.vehicle_positions(VUT))
        scene, self._has_approached = scene_of(self._constants, target, front, world.speeds(), self._has_approached)
        self._sample += 1
        return scene


def _per_vehicle(values: Sequence[Any], size: int) -> Any:
    """The value of all scenes as a scalar if they agree, else the scene's value for each vehicle, shape (K * size,)."""
    return values[0] if all(value == values[0] for value in values) else np.repeat(values, size)


def _table(columns: Sequence[Any], length: int) -> Any:
    """K columns of samples, padded with their last values, as a table of shape (length, K); a scalar if all are the
    same scalar.
    """
    if all(np.ndim(column) == 0 and column == columns[0] for column in columns):
        return np.asarray(columns[0])
    table = np.empty((length, len(columns)), dtype=np.result_type(*columns))
    for k, column in enumerate(columns):
        table[:, k] = column if np.ndim(column) == 0 else column[np.minimum(np.arange(length), len(column) - 1)]
    return table
