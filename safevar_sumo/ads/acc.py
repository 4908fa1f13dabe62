"""Adaptive cruise control (Milanes and Shladover 2014; Xiao, Wang, van Arem 2017), as SUMO's `MSCFModel_ACC` computes
it.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta

from safevar_sumo.ads.base import PositiveParameter
from safevar_sumo.ads.driver import CarFollowing
from safevar_sumo.records import FloatArray

# Gains of the modes [1/s for speeds, 1/s^2 for gaps] and thresholds: defaults of MSCFModel_ACC.
SPEED_GAIN = -0.4
CLOSING_GAINS = 0.8, 0.04
KEEPING_GAINS = 0.07, 0.23
AVOIDING_GAINS = 0.23, 0.8
FOLLOWING_GAP = 100.0  # m, largest gap at which it follows
GAP_TOLERANCE, SPEED_TOLERANCE = 0.2, 0.1  # m, m/s: errors below which it keeps the gap


class Acc(CarFollowing, frozen=True, kw_only=True):
    """Holds a speed, or a time headway behind a leader.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s].
    headway, standing_gap
        Desired time headway [s], and additional gap [m].
    corridor
        Half the width of the corridor that it watches [m].
    """

    cruise_speed: PositiveParameter = 13.89
    headway: PositiveParameter = 1.0
    standing_gap: Annotated[float, Meta(ge=0, le=100)] = 2.5
    corridor: PositiveParameter = 1.4

    def acceleration_at(self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """Commanded acceleration [m/s^2] at a gap from bumper to bumper [m] and speeds [m/s], shape (N,)."""
        excess_speed, relative_speed = speed - self.cruise_speed, leader_speed - speed
        gap_error = gap - self.standing_gap - _standing_distance(speed) - self.headway * speed
        keeps_gap = (np.abs(gap_error) < GAP_TOLERANCE) & (np.abs(excess_speed) < SPEED_TOLERANCE)
        gap_law = np.where(
            gap_error < 0,
            _acceleration_law(AVOIDING_GAINS, relative_speed, gap_error),
            _acceleration_law(CLOSING_GAINS, relative_speed, gap_error),
        )
        acceleration = np.where(keeps_gap, _acceleration_law(KEEPING_GAINS, relative_speed, gap_error), gap_law)
        return np.where(gap - self.standing_gap > FOLLOWING_GAP, SPEED_GAIN * excess_speed, acceleration)


def _standing_distance(speed: FloatArray) -> FloatArray:
    """Distance to keep in addition to the headway [m] (Xiao et al. 2017): 2 m below 10.8 m/s, 75 / v - 5 up to 15 m/s,
    none above.
    """
    return np.minimum(np.maximum(75 / np.maximum(speed, 1.0) - 5, 0.0), 2.0)


def _acceleration_law(gains: tuple[float, float], relative_speed: FloatArray, gap_error: FloatArray) -> FloatArray:
    return gains[0] * relative_speed + gains[1] * gap_error
