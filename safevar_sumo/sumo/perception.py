"""What ADSs observe: the obstacle in the scene of each vehicle, delayed by the weather."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from safevar_sumo.ads.base import DelayLine
from safevar_sumo.errors import SimulationError
from safevar_sumo.records import ALL_TRUE, BoolArray, Encounter, FloatArray, Observation, Trace
from safevar_sumo.scenarios import Point, Scenario, Scene
from safevar_sumo.scenarios.base import Frame
from safevar_sumo.scenarios.target import EncounterConstants, Target, TargetTest, scene_of
from safevar_sumo.study import Weather
from safevar_sumo.sumo.bodies import Motion, World
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.recording import Recording

OCCLUDED_VALUES = np.array([[np.inf], [np.inf], [0.0], [0.0]])
"""Gap and lateral position [m], lateral speed and speed [m/s] of an occluded obstacle."""


class Observer(Protocol):
    """Observes the obstacles of all vehicles."""

    def observe(self, motion: Motion, is_open: BoolArray) -> Scene:
        """The scene now; must be called at every sample."""


class Perception:
    """Observations, step by step, of K groups of `size` vehicles; group k is in weather k."""

    def __init__(self, weathers: Sequence[Weather], step: float, size: int) -> None:
        self._visibility = per_vehicle([weather.visibility for weather in weathers], size)
        delays = per_vehicle([weather.recognition_delay for weather in weathers], size)
        everybody: Any = slice(None)  # faster than indices
        if np.ndim(delays) == 0:
            self._lines = [(everybody, DelayLine.by(delays, step))]
            return
        steps, fractions = DelayLine.parts(delays, step)
        groups = [np.flatnonzero(steps == count) for count in np.unique(steps)]
        self._lines = [(group, DelayLine(int(steps[group[0]]), fractions[group])) for group in groups]

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observation at this step; must be called in every step.

        An occluded obstacle appears at rest, infinitely far away.
        """
        values = np.empty((len(OCCLUDED_VALUES) + 1, len(speed)))
        for row, quantity in enumerate((scene.gap, scene.lateral, scene.lateral_speed, scene.obstacle_speed, speed)):
            values[row] = quantity
        if scene.visible is not ALL_TRUE:
            values[:-1] = np.where(scene.visible, values[:-1], OCCLUDED_VALUES)
        seen = np.empty_like(values)
        for k, (vehicles, line) in enumerate(self._lines):
            seen[:, vehicles], next_line = line.delayed(values[:, vehicles])
            self._lines[k] = vehicles, next_line
        gap, lateral, lateral_speed, obstacle_speed, old_speed = seen
        return Observation(
            time, speed, gap, old_speed - obstacle_speed, lateral, lateral_speed, self._visibility, obstacle_speed
        )


class SceneObserver:
    """Observes the obstacle of a scenario in a world."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._scenario, self._world = scenario, world
        self._memory = world.begin(scenario)

    def observe(self, motion: Motion, is_open: BoolArray) -> Scene:
        scene, self._memory = self._scenario.observe(self._world, self._world.step_length, self._memory)
        return scene


class TargetObserver:
    """Observes the targets of K recorded scenes with `size` vehicles each, whose motion it computes once."""

    def __init__(self, scenarios: Sequence[TargetTest], recordings: Sequence[Recording], size: int) -> None:
        self._step_length, self._size, self._sample = recordings[0].step_length, size, -1
        at_samples = [
            scenario.at_all_samples(RecordedWorld.at_all_samples(recording), recording.step_length)
            for scenario, recording in zip(scenarios, recordings, strict=True)
        ]
        motions, targets, absences = zip(*at_samples, strict=True)
        coordinates = np.array([(*motion.frame.origin, *motion.frame.direction) for motion in motions]).T.tolist()
        x, y, along_x, along_y = (per_vehicle(values, size) for values in coordinates)
        self._frame = Frame((x, y), (along_x, along_y))
        self._constants = EncounterConstants._make(
            per_vehicle(column, size) for column in zip(*(motion.constants for motion in motions), strict=True)
        )
        length = max(map(len, absences))
        self._target = [_table(column, length) for column in zip(*targets, strict=True)]
        self._absence = _table(absences, length)
        self._has_approached = np.zeros(size * len(recordings), dtype=bool)

    def observe(self, motion: Motion, is_open: BoolArray) -> Scene:
        """The scene of all vehicles now; raises `SimulationError` if the target of an open run is not on the road."""
        self._sample += 1
        absence = self._absence[self._sample]
        if absence.any() and (absence & is_open.reshape(-1, self._size).any(axis=1)).any():
            raise SimulationError(
                f"SUMO failed: the target is not on the road at {self._sample * self._step_length:g} s"
            )
        target = Target._make(
            column if column.ndim == 0 else column[self._sample].repeat(self._size) for column in self._target
        )
        front = self._frame.along(motion.fronts)
        scene, self._has_approached = scene_of(self._constants, target, front, motion.speeds, self._has_approached)
        return scene


def encounter_of(points: Sequence[Point], trace: Trace) -> Encounter:
    """The geometry of the encounters at all points, from which the metrics are computed."""
    if len(points) == 1:
        return points[0].scenario.encounter(trace)
    size = trace.speed.shape[1] // len(points)
    encounters = [point.scenario.encounter(trace.of(slice(k * size, (k + 1) * size))) for k, point in enumerate(points)]
    return Encounter(*(np.concatenate(columns, axis=1) for columns in zip(*encounters, strict=True)))


def per_vehicle(values: Sequence[Any], size: int) -> Any:
    """The values of K points, repeated for `size` vehicles each, shape (K * size,); a single value, or that of the only
    point, if all are equal.
    """
    is_shared = len(values) == 1 or all(value == values[0] for value in values)
    return values[0] if is_shared else np.repeat(values, size)


def _table(columns: Sequence[Any], length: int) -> Any:
    """K columns of samples, padded with their last values, as a table of shape (length, K); a scalar if all are the
    same scalar.
    """
    if all(np.ndim(column) == 0 and column == columns[0] for column in columns):
        return np.asarray(columns[0])
    columns = [np.broadcast_to(column, length) if np.ndim(column) == 0 else column for column in columns]
    return np.stack([np.pad(column, (0, length - len(column)), mode="edge") for column in columns], axis=1)
