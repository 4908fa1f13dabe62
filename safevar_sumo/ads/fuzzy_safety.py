"""The fuzzy safety model (Mattas et al. 2020, "Fuzzy Surrogate Safety Metrics"), in UN R157 as amended.

The regulation means it for cars that cut in, cut out or brake on motorways; its use for pedestrians is ours.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.base import Ads, NonNegativeParameter, PositiveParameter
from safevar_sumo.ads.driver import HARDEST_BRAKING, Reaction, initial_reaction, is_in_the_way, react
from safevar_sumo.records import Command, FloatArray, Nominal, Observation

LEAST_DIVISOR = 1e-9
"""Lower bound of accelerations and widths by which numbers are divided [m/s^2, m]."""


class FuzzySafety(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed; brakes according to two fuzzy metrics: PFS rises as the gap falls below the safe distance, CFS
    as a collision nears.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    reaction_time
        Reaction time rt [s].
    comfortable, hardest, leader_deceleration
        Decelerations b_min and b_max of its own braking, b_u of the leader's braking [m/s^2].
    margin
        Added to the safe distance and subtracted from the gap [m].
    corridor
        Half the width of the corridor that it watches [m].
    """

    cruise_speed: PositiveParameter | None = None
    reaction_time: NonNegativeParameter = 0.75
    comfortable: PositiveParameter = 4.0
    hardest: PositiveParameter = 6.0
    leader_deceleration: PositiveParameter = 7.0
    margin: NonNegativeParameter = 2.0
    corridor: PositiveParameter = 1.4

    def start(self, n: int, nominal: Nominal, step: float) -> Reaction:
        return initial_reaction(n, nominal, step)

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        acceleration = (seen.speed - (seen.speed if memory.cruise is None else memory.speed)) / memory.step
        gap = np.where(is_in_the_way(seen, self.corridor), seen.gap, np.inf)
        pfs = self.proactive_metric(gap, seen.speed, seen.obstacle_speed)
        cfs = self.critical_metric(gap, seen.speed, seen.obstacle_speed, acceleration)
        deceleration = np.where(
            cfs > 0, cfs * (self.hardest - self.comfortable) + self.comfortable, pfs * self.comfortable
        )
        return react(
            seen,
            memory,
            (pfs > 0) | (cfs > 0),
            np.minimum(deceleration, HARDEST_BRAKING),
            reaction_time=self.reaction_time,
            corridor=self.corridor,
            cruise_speed=self.cruise_speed,
        )

    def proactive_metric(self, gap: FloatArray, v: FloatArray, u: FloatArray) -> FloatArray:
        """PFS in [0, 1] at a gap [m] and speeds v and u (leader) [m/s], shape (N,): 0 above the safe distance, 1 below
        the unsafe one.
        """
        leader_stop = u * u / (2 * self.leader_deceleration)
        safe_distance = v * self.reaction_time + v * v / (2 * self.comfortable) - leader_stop + self.margin
        unsafe_distance = v * self.reaction_time + v * v / (2 * self.hardest) - leader_stop
        return _falling_ramp(gap - self.margin, unsafe_distance, safe_distance)

    def critical_metric(self, gap: FloatArray, v: FloatArray, u: FloatArray, a: FloatArray) -> FloatArray:
        """CFS in [0, 1] at a gap [m], speeds v and u [m/s] and the acceleration a of the vehicle [m/s^2], shape
        (N,).
        """
        acceleration = np.maximum(a, -self.comfortable)
        next_speed = v + self.reaction_time * acceleration
        approach = (v + acceleration * self.reaction_time / 2 - u) * self.reaction_time
        square = (next_speed - u) * (next_speed - u)
        fuzzy_value = _falling_ramp(
            gap, approach + square / (2 * self.hardest), approach + square / (2 * self.comfortable)
        )
        slowing_value = np.where(
            gap < (v - u) * (v - u) / (2 * np.maximum(np.abs(acceleration), LEAST_DIVISOR)), 1.0, 0.0
        )
        return np.where(v <= u, 0.0, np.where(next_speed < u, slowing_value, fuzzy_value))


def _falling_ramp(value: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """1 below `low`, 0 above `high`, linear between them."""
    width = np.maximum(high - low, LEAST_DIVISOR)
    return np.minimum(np.maximum((high - np.minimum(value, high + width)) / width, 0.0), 1.0)
