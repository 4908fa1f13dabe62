"""The braking that UN Regulation No. 157, 5.2.5.2, requires of an automated lane keeping system."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.base import Ads, PositiveParameter
from safevar_sumo.ads.driver import Reaction, initial_reaction, is_in_the_way, react, time_to_reach
from safevar_sumo.records import Command, Nominal, Observation


class R157(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed; reacts to a TTC below (v - u) / (2 * 6 m/s^2) + 0.35 s + 0.1 s, and brakes with 6 m/s^2 at once.

    v and u are the speeds of the vehicle and the obstacle. UN R157 means this for cars that cut in, cut out or
    brake on motorways; its use for pedestrians is ours.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    deceleration, reaction_time, margin
        6 m/s^2, 0.35 s and 0.1 s in the regulation.
    corridor
        Half the width of the corridor that it watches [m].
    """

    cruise_speed: PositiveParameter | None = None
    deceleration: PositiveParameter = 6.0
    reaction_time: Annotated[float, Meta(ge=0, le=60)] = 0.35
    margin: Annotated[float, Meta(ge=0, le=60)] = 0.1
    corridor: PositiveParameter = 1.4

    def start(self, n: int, nominal: Nominal, step: float) -> Reaction:
        return initial_reaction(n, nominal, step)

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        critical_ttc = seen.closing_speed / (2 * self.deceleration) + self.reaction_time + self.margin
        danger = is_in_the_way(seen, self.corridor) & (time_to_reach(seen) < critical_ttc)
        return react(
            seen,
            memory,
            danger,
            np.full_like(seen.speed, self.deceleration),
            reaction_time=self.reaction_time,
            jerk=self.deceleration / memory.step,
            corridor=self.corridor,
            cruise_speed=self.cruise_speed,
        )
