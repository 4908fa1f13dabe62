"""Full braking at the first possible moment: what nobody can do better in the lane."""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.base import Positive
from safevar_sumo.ads.driver import Reaction, Start, in_the_way, react, unaware
from safevar_sumo.records import Command, Nominal, Observation

AS_HARD_AS_CAN_BE = 1e6
"""More than any brake does [m/s^2]: the pedal is on the floor."""


class FullBraking(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed; brakes fully, at once, when somebody is in its way or on course to be there when it is.

    Parameters
    ----------
    cruise_speed
        Speed that it holds [m/s], by default the one that it starts with.
    corridor
        Half the width of its way [m].
    start_throttle
        Throttle of the run's first steps, one value a step, as long as it does not brake [-].
    """

    cruise_speed: Positive | None = None
    corridor: Positive = 1.4
    start_throttle: Start = ()
    own_reactions = True

    def start(self, n: int, nominal: Nominal, step: float) -> Reaction:
        return unaware(n, nominal, step)

    def drive(self, seen: Observation, memory: Reaction) -> tuple[Command, Reaction]:
        hardest = np.full_like(seen.speed, AS_HARD_AS_CAN_BE)
        return react(seen, memory, in_the_way(seen, self.corridor), hardest, reaction_time=0.0, jerk=AS_HARD_AS_CAN_BE / memory.step,
                     corridor=self.corridor, cruise_speed=self.cruise_speed, start=self.start_throttle)
