"""Full braking at the first possible moment, the best that a driver can do in the lane."""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.base import Ads, PositiveParameter
from safevar_sumo.ads.driver import Reaction, StartThrottle, initial_reaction, is_in_the_way, react
from safevar_sumo.records import Command, Nominal, Observation

UNLIMITED_BRAKING = 1e6
"""Deceleration beyond every brake [m/s^2]; it presses the pedal fully."""


class FullBraking(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed; brakes fully as soon as an obstacle is in its way or will be there when the vehicle arrives.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    corridor
        Half the width of the corridor that it watches [m].
    start_throttle
        Throttle in the run's first steps, one value per step, until it brakes [-].
    """

    cruise_speed: PositiveParameter | None = None
    corridor: PositiveParameter = 1.4
    start_throttle: StartThrottle = ()

    def start(self, n: int, nominal: Nominal, step: float) -> Reaction:
        return initial_reaction(n, nominal, step)

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        deceleration = np.full_like(seen.speed, UNLIMITED_BRAKING)
        return react(
            seen,
            memory,
            is_in_the_way(seen, self.corridor),
            deceleration,
            reaction_time=0.0,
            jerk=UNLIMITED_BRAKING / memory.step,
            corridor=self.corridor,
            cruise_speed=self.cruise_speed,
            start=self.start_throttle,
        )
