"""A lane on which vehicles drive among bodies on tracks, without SUMO."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.sumo.bodies import BodyPairs, VehicleStates, distance_covered
from safevar_sumo.sumo.traffic import LANE, Traffic
from safevar_sumo.vehicles import SumoType


class LaneWorld:
    """A `VehicleWorld` of N vehicles on a lane among bodies on tracks. The vehicles move by SUMO's
    ballistic update, so that their positions are the same as in SUMO.
    """

    frame = LANE

    def __init__(self, traffic: Traffic, step: float) -> None:
        self.n = traffic.n
        self.step_length = step
        self._traffic = traffic
        self._front = np.zeros(traffic.n)
        self._speed = traffic.start_speeds
        self._sample = 0

    def enter(
        self, types: SumoType | None, *, keeps_drivers: bool = False
    ) -> VehicleStates:
        return self._states(np.ones(self.n, bool))

    def step(self, speeds: FloatArray, is_open: BoolArray) -> VehicleStates:
        covered = distance_covered(self._speed, speeds, self.step_length)
        self._front = np.where(is_open, self._front + covered, self._front)
        self._speed = np.where(is_open, speeds, self._speed)
        self._sample += 1
        return self._states(is_open)

    def _states(self, is_open: BoolArray) -> VehicleStates:
        """The states of the vehicles at this sample. Open runs (`is_open`, shape (N,)) may hit
        bodies.
        """
        hits = self._traffic.hits(self._sample, self._front, self._speed, is_open)
        fronts = np.zeros((self.n, 2))
        fronts[:, 0] = self._front
        return VehicleStates(fronts, self._speed, hits)

    def bodies(self, vehicles: Sequence[int]) -> BodyPairs:
        return self._traffic.bodies(vehicles, self._front, self._speed)

    def vehicle_length(self, actor: str) -> float:
        return self._traffic.length

    @property
    def vehicle_width(self) -> float:
        return self._traffic.width
