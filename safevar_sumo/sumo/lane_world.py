"""Vehicles on a straight lane among bodies that move by tracks, without SUMO."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios.base import Frame
from safevar_sumo.sumo.bodies import Body, Motion
from safevar_sumo.sumo.recorded_world import distance_covered
from safevar_sumo.sumo.stage import Stage
from safevar_sumo.vehicles import SumoType

LANE = Frame((0.0, 0.0), (1.0, 0.0))
"""The coordinates of the vehicle's lane, in which tracks are."""


class LaneWorld:
    """N vehicles on a stage, which move by SUMO's ballistic update."""

    frame = LANE

    def __init__(self, stage: Stage, start_speeds: FloatArray, step: float) -> None:
        self.n = stage.n
        self.step_length = step
        self._stage = stage
        self._front = np.zeros(stage.n)
        self._speed = start_speeds
        self._sample = 0

    def enter(self, types: SumoType | None, *, keeps_drivers: bool = False) -> Motion:
        return self._motion(np.ones(self.n, dtype=bool))

    def step(self, speeds: FloatArray, is_open: BoolArray) -> Motion:
        covered = distance_covered(self._speed, speeds, self.step_length)
        self._front = np.where(is_open, self._front + covered, self._front)
        self._speed = np.where(is_open, speeds, self._speed)
        self._sample += 1
        return self._motion(is_open)

    def _motion(self, is_open: BoolArray) -> Motion:
        hits = self._stage.hits(self._sample, self._front, self._speed, is_open)
        fronts = np.zeros((self.n, 2))
        fronts[:, 0] = self._front
        return Motion(fronts, self._speed, hits)

    def bodies(self, vehicles: Sequence[int]) -> tuple[Body, Body]:
        return self._stage.bodies(vehicles, self._front, self._speed)

    def vehicle_length(self, actor: str) -> float:
        return self._stage.length

    @property
    def vehicle_width(self) -> float:
        return self._stage.width
