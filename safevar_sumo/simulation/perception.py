"""What an ADS makes out of the scene: its own speed at once, everything else as late as the weather has it."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import FloatArray, Observation
from safevar_sumo.scenarios.base import Scene
from safevar_sumo.study import Weather
from safevar_sumo.vehicles.delay import delayed, history, remembered


class Perception:
    """Observations of N vehicles, one step after the other."""

    def __init__(self, weather: Weather, n: int, step: float) -> None:
        self._weather, self._step = weather, step
        self._delay = np.full(n, weather.recognition_delay)
        self._past: FloatArray | None = None

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """What is seen at this step; every step is to be shown."""
        gap, closing_speed, lateral, lateral_speed = self._late(np.stack([scene.gap, speed, scene.lateral, scene.lateral_speed]))
        return Observation(time, speed, gap, closing_speed, lateral, lateral_speed, self._weather.visibility)

    def _late(self, now: FloatArray) -> FloatArray:
        if not self._weather.recognition_delay:
            return now
        if self._past is None:
            self._past = history(self._weather.recognition_delay, self._step, now)
        else:
            self._past = remembered(self._past, now)
        return delayed(self._past, self._delay, self._step)
