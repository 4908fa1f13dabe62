"""What N vehicles meet when they are not all in the same scenario: every part of a batch has a point of the study to itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from safevar_sumo.records import Command, Encounter, FloatArray, Observation, Trace
from safevar_sumo.scenarios import Point, Scene
from safevar_sumo.simulation.perception import Perception
from safevar_sumo.simulation.world import SumoWorld

R = TypeVar("R", Scene, Observation)


class Parts:
    """A batch whose k-th part of equally many vehicles is in the k-th point; of drivers with reactions of their own, or not."""

    def __init__(self, points: Sequence[Point], world: SumoWorld, n: int, own_reactions: bool = False) -> None:
        self._size = size = n // len(points)
        self._points, self._step = points, world.step_length
        self._rows = [slice(k * size, (k + 1) * size) for k in range(len(points))]
        self._worlds = [world] if len(points) == 1 else [world.part(rows.start, size) for rows in self._rows]
        weathers = [point.weather.without_reactions if own_reactions else point.weather for point in points]
        self._perceptions = [(Perception(weather, self._step), np.repeat([one == weather for one in weathers], size).nonzero()[0])
                             for k, weather in enumerate(weathers) if weather not in weathers[:k]]
        self._order = np.argsort(np.concatenate([rows for _, rows in self._perceptions]))
        self._memories = [point.scenario.begin(part) for point, part in zip(points, self._worlds, strict=True)]
        self.last = np.repeat([round(point.scenario.duration / self._step) for point in points], size)

    def scene(self) -> Scene:
        """Where the obstacles of all vehicles are now."""
        scenes = []
        for k, (point, world) in enumerate(zip(self._points, self._worlds, strict=True)):
            scene, self._memories[k] = point.scenario.observe(world, self._step, self._memories[k])
            scenes.append(scene)
        return scenes[0] if len(scenes) == 1 else _joined(scenes, [self._size] * len(scenes))

    def seen(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """What all vehicles see of it."""
        if len(self._perceptions) == 1:
            return self._perceptions[0][0].observe(time, speed, scene)
        observations = [perception.observe(time, speed[rows], Scene._make(values[rows] if values.ndim else values for values in scene))
                        for perception, rows in self._perceptions]
        joined = _joined(observations, [len(rows) for _, rows in self._perceptions])
        return Observation._make(np.asarray(values)[self._order] if np.ndim(values) else values for values in joined)

    def braked(self, command: Command) -> Command:
        """What becomes of all vehicles' commands."""
        if len(self._perceptions) == 1:
            return self._perceptions[0][0].braked(command)
        commands = [perception.braked(Command(*(pedal[rows] for pedal in command))) for perception, rows in self._perceptions]
        return Command(*(np.concatenate(pedals)[self._order] for pedals in zip(*commands, strict=True)))

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry that the metrics are computed from."""
        if len(self._points) == 1:
            return self._points[0].scenario.encounter(trace)
        parts = [point.scenario.encounter(trace.of(rows)) for point, rows in zip(self._points, self._rows, strict=True)]
        return Encounter(*(np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True)))


def _joined(records: Sequence[R], sizes: Sequence[int]) -> R:
    """Records of arrays of shape (size,), or of what stands for one, as a record of longer arrays, or of what stands for all."""
    return type(records[0])._make(_concatenated(column, sizes) for column in zip(*records, strict=True))


def _concatenated(parts: Sequence[Any], sizes: Sequence[int]) -> Any:
    if np.ndim(parts[0]) == 0 and all(one is parts[0] for one in parts):
        return parts[0]
    return np.concatenate([one if np.ndim(one) else np.full(size, one) for one, size in zip(parts, sizes, strict=True)])
