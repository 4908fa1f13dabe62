"""The competent and careful human driver of UN Regulation No. 157, annex 4, appendix 3 (longitudinal part)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.acc import KEEPING
from safevar_sumo.ads.base import NotNegative, Positive
from safevar_sumo.ads.driver import HARDEST, Reaction, Start, in_the_way, react, time_to_reach, unaware
from safevar_sumo.records import TIME_ROUNDING, BoolArray, Command, FloatArray, Nominal, Observation


class _Memory(NamedTuple):
    """Reaction; the obstacle's first lateral position [m], infinite before any; whether it was in the way then; time since it strayed [s],
    negative before.
    """

    reaction: Reaction
    first: FloatArray
    ahead: BoolArray
    strayed: FloatArray


class CompetentDriver(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed or a headway; perceives obstacles that move into its way, reacts to a TTC below 2 s, and brakes with up to 0.774 g.

    After a stop it waits until the way is clear. Behind a moving leader it keeps its headway with the accelerator alone:
    a = 0.07 (u - v) + 0.23 (gap - headway v), the gap control of Milanes and Shladover (2014), and not below `-lets_go`.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    critical_ttc, reaction_time
        Time to collision that counts as a danger, and reaction time before braking [s].
    stray, perception_time
        An obstacle that enters the way is perceived `perception_time` after it has moved `stray` from its first lateral position [m, s].
    lets_go
        Coasting deceleration while it reacts or increases its gap [m/s^2].
    headway
        Time headway at which it follows [s].
    corridor
        Half the width of the corridor that it watches [m].
    start_throttle
        Throttle in the run's first steps, one value per step, until it sees a danger [-].
    """

    cruise_speed: Positive | None = None
    critical_ttc: Positive = 2.0
    reaction_time: NotNegative = 0.75
    stray: NotNegative = 0.375
    perception_time: NotNegative = 0.4
    lets_go: NotNegative = 0.4
    headway: Positive = 2.0
    corridor: Positive = 1.4
    start_throttle: Start = ()

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        return _Memory(unaware(n, nominal, step), np.full(n, np.inf), np.zeros(n, dtype=bool), np.full(n, -1.0))

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        perceived, memory = self._perceived(seen, memory)
        ahead = perceived & in_the_way(seen, self.corridor)
        command, reaction = react(
            seen, memory.reaction, ahead & (time_to_reach(seen) < self.critical_ttc), np.full_like(seen.speed, HARDEST),
            reaction_time=self.reaction_time, corridor=self.corridor, coasting_deceleration=self.lets_go, cruise_speed=self.cruise_speed,
            start=self.start_throttle, following=self._following(seen, ahead))
        return command, memory._replace(reaction=reaction)

    def _following(self, seen: Observation, ahead: BoolArray) -> FloatArray:
        """Acceleration that keeps the headway to a moving leader [m/s^2]; infinite without one."""
        gap = np.where(ahead, seen.gap, 0.0)
        law = KEEPING[0] * (seen.obstacle_speed - seen.speed) + KEEPING[1] * (gap - self.headway * seen.speed)
        return np.where(ahead & (seen.obstacle_speed > 0), np.maximum(law, -self.lets_go), np.inf)

    def _perceived(self, seen: Observation, memory: _Memory) -> tuple[BoolArray, _Memory]:
        sighted = np.isfinite(seen.gap) & np.isfinite(seen.lateral)
        lateral = np.where(sighted, seen.lateral, 0.0)
        begins = sighted & ~np.isfinite(memory.first)
        first = np.where(begins, lateral, memory.first)
        ahead = memory.ahead | (begins & (np.abs(lateral) <= self.corridor))
        away = np.abs(lateral - np.where(np.isfinite(first), first, 0.0))
        strays = sighted & (away >= self.stray)
        strayed = np.where(memory.strayed >= 0, memory.strayed + memory.reaction.step, np.where(strays, 0.0, -1.0))
        return ahead | (strayed >= self.perception_time - TIME_ROUNDING), memory._replace(first=first, ahead=ahead, strayed=strayed)
