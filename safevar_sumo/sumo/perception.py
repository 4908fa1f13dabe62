"""What ADSs observe: the obstacle in the scene of each vehicle, delayed by the weather."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from safevar_sumo.ads.base import DelayLine
from safevar_sumo.records import (
    ALL_TRUE,
    Encounter,
    FloatArray,
    IntArray,
    Observation,
    Quantity,
    Trace,
)
from safevar_sumo.scenarios import Scene, WorldScenario
from safevar_sumo.scenarios.base import ScenarioMemory
from safevar_sumo.study import Weather
from safevar_sumo.sumo.bodies import SceneWorld, VehicleStates

OCCLUDED = {
    "gap": np.inf,
    "lateral": np.inf,
    "lateral_speed": 0.0,
    "obstacle_speed": 0.0,
    "obstacle_width": 0.0,
    "obstacle_length": 0.0,
    "obstacle": 0.0,
}
"""What is observed of an occluded obstacle [m, m/s]."""
_UNSEEN = np.array([*OCCLUDED.values()])[:, None]


class Observer(Protocol):
    """Observes the obstacles of all vehicles."""

    def observe(self, motion: VehicleStates) -> Scene:
        """The scene now; must be called at every sample."""

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry of the encounters, from which the metrics are computed."""


class Perception:
    """Observations, step by step, of K groups of `size` vehicles; group k is in weather k."""

    def __init__(self, weathers: Sequence[Weather], step: float, size: int) -> None:
        self._visibility = per_vehicle(
            [weather.visibility for weather in weathers], size
        )

        delays = per_vehicle([weather.recognition_delay for weather in weathers], size)
        self._lines: list[tuple[IntArray | slice, DelayLine]] = []
        # One delay line for all, without indices, is faster than one for each number of steps.
        if np.ndim(delays) == 0:
            self._lines.append((slice(None), DelayLine.by(float(delays), step)))
            return
        steps, fractions = DelayLine.parts(delays, step)
        for count in np.unique(steps):
            group = np.flatnonzero(steps == count)
            self._lines.append((group, DelayLine(int(count), fractions[group])))

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observation at this step; must be called in every step.

        An occluded obstacle appears at rest, infinitely far away.
        """
        # The speed is delayed, too: the closing speed is that of then.
        values = np.empty((len(OCCLUDED) + 1, len(speed)))
        values[-1] = speed
        for row, quantity in enumerate(OCCLUDED):
            values[row] = getattr(scene, quantity)
        if scene.visible is not ALL_TRUE:
            values[:-1] = np.where(scene.visible, values[:-1], _UNSEEN)

        delayed = np.empty_like(values)
        for k, (vehicles, line) in enumerate(self._lines):
            delayed[:, vehicles], next_line = line.delayed(values[:, vehicles])
            self._lines[k] = vehicles, next_line
        obstacle = dict(zip(OCCLUDED, delayed[:-1], strict=True))
        return Observation(
            time=time,
            speed=speed,
            closing_speed=delayed[-1] - obstacle["obstacle_speed"],
            visibility=self._visibility,
            **obstacle,
        )


class SceneObserver:
    """Observes the obstacle of a scenario in a world, once the vehicles are there."""

    def __init__(self, scenario: WorldScenario, world: SceneWorld) -> None:
        self._scenario = scenario
        self.world = world
        self._has_begun = False
        self._memory: ScenarioMemory = None

    def observe(self, motion: VehicleStates) -> Scene:
        if not self._has_begun:
            self._memory = self.world.begin(self._scenario)
            self._has_begun = True
        scene, self._memory = self._scenario.observe(
            self.world, self.world.step_length, self._memory
        )
        return scene

    def encounter(self, trace: Trace) -> Encounter:
        return self._scenario.encounter(trace)


def per_vehicle(values: Sequence[Quantity], size: int) -> Quantity:
    """The values of K points, repeated for `size` vehicles each, shape (K * size,); a single value,
    or that of the only point, if all are equal.
    """
    if len(values) == 1 or all(value == values[0] for value in values):
        return values[0]
    return np.repeat(values, size)
