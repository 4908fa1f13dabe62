"""Responsibility-sensitive safety (Shalev-Shwartz, Shammah, Shashua 2017), longitudinal part, as a reference driver."""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.base import Ads, NonNegativeParameter, PositiveParameter
from safevar_sumo.ads.driver import HARDEST_BRAKING, Reaction, initial_reaction, is_in_the_way, react
from safevar_sumo.records import Command, FloatArray, Nominal, Observation


class Rss(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed; a gap below the safe distance is a danger, to which it reacts and brakes with up to 0.774 g.

    safe distance = v rt + a rt^2 / 2 + (v + rt a)^2 / (2 b) - u^2 / (2 b_u), with the speeds v and u of vehicle and
    leader.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    reaction_time
        rt [s].
    acceleration, deceleration, leader_deceleration
        Acceleration a while it reacts, deceleration b of its own braking and b_u of the leader's braking [m/s^2].
    corridor
        Half the width of the corridor that it watches [m].
    """

    cruise_speed: PositiveParameter | None = None
    reaction_time: NonNegativeParameter = 0.75
    acceleration: NonNegativeParameter = 0.0
    deceleration: PositiveParameter = HARDEST_BRAKING
    leader_deceleration: PositiveParameter = HARDEST_BRAKING
    corridor: PositiveParameter = 1.4

    def start(self, n: int, nominal: Nominal, step: float) -> Reaction:
        return initial_reaction(n, nominal, step)

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        danger = is_in_the_way(seen, self.corridor) & (seen.gap < self.safe_distance(seen.speed, seen.obstacle_speed))
        return react(
            seen,
            memory,
            danger,
            np.full_like(seen.speed, self.deceleration),
            reaction_time=self.reaction_time,
            corridor=self.corridor,
            cruise_speed=self.cruise_speed,
        )

    def safe_distance(self, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """Smallest safe gap [m], at speeds [m/s] of shape (N,)."""
        rt, reaction_speed = self.reaction_time, speed + self.reaction_time * self.acceleration
        distance = (
            speed * rt + self.acceleration * rt * rt / 2 + reaction_speed * reaction_speed / (2 * self.deceleration)
        )
        return np.asarray(np.maximum(distance - leader_speed * leader_speed / (2 * self.leader_deceleration), 0.0))
