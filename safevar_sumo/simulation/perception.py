"""What an ADS makes out of the scene, its own speed at once, everything else as late as the weather has it; and how late it brakes."""

from __future__ import annotations

from collections import deque

import numpy as np

from safevar_sumo.records import EVERYWHERE, Command, FloatArray, Observation
from safevar_sumo.scenarios.base import Scene
from safevar_sumo.study import Weather

STEP_DECIMALS = 6  # of a delay in steps: a whole number of steps is whole
HIDDEN = np.array([[np.inf], [np.inf], [0.0], [0.0]])
"""Gap and lateral place [m], lateral speed and speed [m/s] of somebody who is not seen."""


class Perception:
    """Observations and commands of N vehicles in one weather, one step after the other."""

    def __init__(self, weather: Weather, step: float) -> None:
        self._visibility, self._hesitates = weather.visibility, weather.hesitation > 0
        self._scenes, self._brakes = _Late(weather.recognition_delay, step), _Late(weather.hesitation, step)

    def observe(self, time: float, speed: FloatArray, scene: Scene) -> Observation:
        """What is seen at this step; every step is to be shown. Who is hidden is infinitely far away and still."""
        now = np.empty((len(HIDDEN) + 1, len(speed)))
        now[0], now[1], now[2], now[3], now[4] = scene.gap, scene.lateral, scene.lateral_speed, scene.obstacle_speed, speed
        if scene.visible is not EVERYWHERE:
            now[:-1] = np.where(scene.visible, now[:-1], HIDDEN)
        gap, lateral, lateral_speed, obstacle_speed, own = self._scenes.shown(now)
        return Observation(time, speed, gap, own - obstacle_speed, lateral, lateral_speed, self._visibility, obstacle_speed)

    def braked(self, command: Command) -> Command:
        """What becomes of a command: who is not sure yet what he sees brakes no harder than he wanted a hesitation ago."""
        if not self._hesitates:
            return command
        return Command(command.throttle, np.minimum(command.brake, self._brakes.shown(command.brake)))


class _Late:
    """Values that are told a delay [s] late."""

    def __init__(self, delay: float, step: float) -> None:
        self._whole, self._part = divmod(round(delay / step, STEP_DECIMALS), 1)
        self._past: deque[FloatArray] = deque()

    def shown(self, now: FloatArray) -> FloatArray:
        """What was there a delay ago, linear between two steps; before the first one nothing was different."""
        self._past = self._past or deque([now] * (int(self._whole) + 2), maxlen=int(self._whole) + 2)
        self._past.append(now)
        before, after = self._past[0], self._past[1]
        if not self._part:
            return after
        with np.errstate(invalid="ignore"):  # what appears or vanishes between the two is still as it was
            between = after + (before - after) * self._part
        return np.where(np.isfinite(between), between, before)
