"""A stand-in for Autoware's emergency braking: its published formula and parameters, and its stop operator."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.base import Ads, NonNegativeParameter, PositiveParameter, Trim, is_in_the_way, pedals_for, trim_at
from safevar_sumo.records import TIME_ROUNDING, Command, FloatArray, Nominal, Observation


class _Memory(NamedTuple):
    """The original vehicle; time between calls [s]; initial speed and the pedals that hold it; time since the decision
    to brake, negative before it [s].
    """

    nominal: Nominal
    step: float
    cruise: tuple[FloatArray, Trim] | None
    since: FloatArray


class AutowareAeb(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed until an obstacle in its way is nearer than the distance of Autoware's emergency braking; then
    stops with a target acceleration, reached with a target jerk.

    distance = v t_response + v^2 / (2 a_ego_min) - u^2 / (2 a_obj_min) + longitudinal_offset_margin, with the speeds v
    and u of vehicle and obstacle. Once it has decided to brake, it brakes until it stands.

    Parameters
    ----------
    cruise_speed, cruise_gain
        Speed to hold [m/s], by default the initial speed, and acceleration per speed error [1/s].
    t_response, longitudinal_offset_margin
        Response time [s] and gap [m] in the distance.
    a_ego_min, a_obj_min
        Decelerations of vehicle and obstacle in the distance [m/s^2]; Autoware states them as negative accelerations.
    target_acceleration, target_jerk
        Deceleration of the emergency stop [m/s^2], and the rate at which it is reached [m/s^3].
    command_delay
        Time from the decision to the first command [s]: an assumption, two cycles of 10 Hz.
    corridor
        Half the width of the corridor that it watches [m].

    Notes
    -----
    The formula is that of the README of autoware_autonomous_emergency_braking; the defaults are the values of
    autoware_launch since commit 1ded9c3a of 2024-12-12. It is a stand-in for one module of several in that stack.
    """

    cruise_speed: PositiveParameter | None = None
    cruise_gain: PositiveParameter = 1.0
    t_response: NonNegativeParameter = 1.0
    a_ego_min: PositiveParameter = 3.0
    a_obj_min: PositiveParameter = 1.0
    longitudinal_offset_margin: NonNegativeParameter = 1.0
    target_acceleration: PositiveParameter = 2.5
    target_jerk: PositiveParameter = 1.5
    command_delay: NonNegativeParameter = 0.2
    corridor: PositiveParameter = 1.4

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        return _Memory(nominal, step, cruise=None, since=np.full(n, -1.0))

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        nominal, step, cruise, since = memory
        if cruise is None:
            speed = seen.speed if self.cruise_speed is None else np.full_like(seen.speed, self.cruise_speed)
            cruise = speed, trim_at(nominal, seen)
        is_near = is_in_the_way(seen, self.corridor) & (seen.gap < self.distance(seen.speed, seen.obstacle_speed))
        since = np.where(since >= 0, since + step, np.where(is_near, 0.0, -1.0))
        ramp = self.target_jerk * np.maximum(since + step / 2 - self.command_delay, 0.0)
        is_braking = since + TIME_ROUNDING >= self.command_delay
        wanted = np.where(
            is_braking & (since >= 0),
            -np.minimum(ramp, self.target_acceleration),
            self.cruise_gain * (cruise[0] - seen.speed),
        )
        return pedals_for(nominal, seen.speed, wanted, cruise[1]), _Memory(nominal, step, cruise, since)

    def distance(self, speed: FloatArray, obstacle_speed: FloatArray) -> FloatArray:
        """The gap below which it brakes [m], at speeds [m/s] of shape (N,)."""
        own = speed * self.t_response + speed * speed / (2 * self.a_ego_min)
        other = obstacle_speed * obstacle_speed / (2 * self.a_obj_min)
        return np.asarray(own - other + self.longitudinal_offset_margin)
