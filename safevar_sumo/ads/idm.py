"""The intelligent driver model (Treiber, Hennecke, Helbing 2000), as SUMO's `MSCFModel_IDM` computes it."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from safevar_sumo.ads.base import PositiveParameter
from safevar_sumo.ads.driver import CarFollowing
from safevar_sumo.records import FloatArray

LEAST_GAP = 0.001  # m; NUMERICAL_EPS of SUMO


class Idm(CarFollowing, frozen=True, kw_only=True):
    """dv/dt = a (1 - (v / v0)^4 - (s* / s)^2), s* = s0 + max(0, v T + v (v - u) / (2 sqrt(a b))) at speed v, gap s,
    leader speed u.

    Parameters
    ----------
    cruise_speed
        v0 [m/s].
    headway, standing_gap
        T [s], s0 [m].
    acceleration, deceleration
        a, b [m/s^2].
    corridor
        Half the width of the corridor that it watches [m].
    """

    cruise_speed: PositiveParameter = 13.89
    headway: PositiveParameter = 1.0
    standing_gap: Annotated[float, Meta(ge=0, le=100)] = 2.5
    acceleration: PositiveParameter = 2.6
    deceleration: PositiveParameter = 4.5
    corridor: PositiveParameter = 1.4

    def acceleration_at(self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """dv/dt [m/s^2] at a gap from bumper to bumper [m] and speeds [m/s], shape (N,)."""
        speed_ratio = speed / self.cruise_speed
        closing_term = speed * (speed - leader_speed) / (2 * math.sqrt(self.acceleration * self.deceleration))
        desired_gap = self.standing_gap + np.maximum(speed * self.headway + closing_term, 0.0)
        positive_gap = np.maximum(gap, LEAST_GAP)
        return np.asarray(
            self.acceleration
            * (
                1
                - speed_ratio * speed_ratio * speed_ratio * speed_ratio
                - desired_gap * desired_gap / (positive_gap * positive_gap)
            )
        )
