"""Observations of driving systems: the obstacle in each vehicle's scene, delayed by the weather."""

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
"""Observed values of an obstacle that is occluded: it is at rest, infinitely far away [m, m/s]."""
_UNSEEN = np.array(list(OCCLUDED.values()))[:, np.newaxis]


class Observer(Protocol):
    """The contract of observers, which return the scene of all vehicles at each sample."""

    def observe(self, motion: VehicleStates) -> Scene:
        """The scene at the current sample. This method is called at every sample."""

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry of the encounters, from which the metrics are computed."""


class Perception:
    """Turns scenes into observations, step by step, for K groups of `size` vehicles. Group k drives
    in weather k, which delays what the vehicles recognise.
    """

    def __init__(self, weathers: Sequence[Weather], step: float, size: int) -> None:
        visibilities = [weather.visibility for weather in weathers]
        self._visibility = per_vehicle(visibilities, size)
        delays = per_vehicle([weather.recognition_delay for weather in weathers], size)
        self._lines: list[tuple[IntArray | slice, DelayLine]] = []
        # With equal delays, one delay line without indices for all vehicles is the fastest way.
        if np.ndim(delays) == 0:
            self._lines.append((slice(None), DelayLine.by(float(delays), step)))
            return
        steps, fractions = DelayLine.parts(delays, step)
        for count in np.unique(steps):
            group = np.flatnonzero(steps == count)
            self._lines.append((group, DelayLine(int(count), fractions[group])))

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """The observation at this step: the scene as it was one recognition delay ago, and the
        vehicles' speeds now. This method is called in every step.

        An occluded obstacle appears at rest, infinitely far away.
        """
        # The closing speed needs the vehicle's speed of the same time as the obstacle's speed.
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
    """Observes the obstacle of a scenario in a world. The scenario begins with the first
    observation, because it needs vehicles that have entered the world.
    """

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
    """The values of K points, each repeated for the `size` vehicles of the point, shape (K *
    size,). If the values of all points are equal, the result is this value alone.
    """
    if len(values) == 1 or all(value == values[0] for value in values):
        return values[0]
    return np.repeat(values, size)


def of_vehicles(values: Sequence[Quantity], size: int) -> FloatArray:
    """The values of K points for the `size` vehicles of each point, joined, shape (K * size,). A
    value of a point is a number, an array of shape (size,), or None, which becomes NaN.
    """
    return np.concatenate([np.full(size, value, float) for value in values])
