"""The competent and careful human driver of UN Regulation No. 157, annex 4, appendix 3 (longitudinal part)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.acc import KEEPING_GAINS
from safevar_sumo.ads.base import Ads, NonNegativeParameter, PositiveParameter
from safevar_sumo.ads.driver import (
    HARDEST_BRAKING,
    Reaction,
    StartThrottle,
    initial_reaction,
    is_in_the_way,
    react,
    time_to_reach,
)
from safevar_sumo.records import TIME_ROUNDING, BoolArray, Command, FloatArray, Nominal, Observation


class _Memory(NamedTuple):
    """The reaction; the lateral position of the obstacle when it was first sensed [m], infinite until then; whether it
    was in the way there; the time since it strayed from there [s], negative until it does.
    """

    reaction: Reaction
    first_lateral: FloatArray
    first_in_way: BoolArray
    stray_time: FloatArray


class CompetentDriver(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Holds its speed or a headway; perceives obstacles that move into its way, reacts to a TTC below 2 s, and brakes
    with up to 0.774 g.

    UN R157 means this driver for cars that cut in, cut out or brake on motorways; its use for pedestrians is ours.

    While it reacts it releases the accelerator, and the vehicle coasts. After a stop it waits until the way is clear.
    Behind a moving leader it keeps its headway by the accelerator only:
    a = 0.07 (u - v) + 0.23 (gap - headway v), the gap control of Milanes and Shladover (2014), but at least `-lets_go`;
    u and v are the speeds of leader and vehicle.

    Parameters
    ----------
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    critical_ttc, reaction_time
        Time to collision that counts as a danger, and reaction time before braking [s].
    stray, perception_time
        An obstacle that enters the way is perceived `perception_time` after it has moved `stray` from its first lateral
        position [m, s].
    lets_go
        Largest deceleration while it increases its gap [m/s^2].
    headway
        Time headway at which it follows [s].
    corridor
        Half the width of the corridor that it watches [m].
    start_throttle
        Throttle in the run's first steps, one value per step, until it sees a danger [-].
    """

    cruise_speed: PositiveParameter | None = None
    critical_ttc: PositiveParameter = 2.0
    reaction_time: NonNegativeParameter = 0.75
    stray: NonNegativeParameter = 0.375
    perception_time: NonNegativeParameter = 0.4
    lets_go: NonNegativeParameter = 0.4
    headway: PositiveParameter = 2.0
    corridor: PositiveParameter = 1.4
    start_throttle: StartThrottle = ()

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        return _Memory(
            initial_reaction(n, nominal, step),
            first_lateral=np.full(n, np.inf),
            first_in_way=np.zeros(n, dtype=bool),
            stray_time=np.full(n, -1.0),
        )

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        is_perceived, memory = self._perceive(seen, memory)
        is_in_way = is_perceived & is_in_the_way(seen, self.corridor)
        command, reaction = react(
            seen,
            memory.reaction,
            is_in_way & (time_to_reach(seen) < self.critical_ttc),
            np.full_like(seen.speed, HARDEST_BRAKING),
            reaction_time=self.reaction_time,
            corridor=self.corridor,
            cruise_speed=self.cruise_speed,
            start=self.start_throttle,
            following=self._following(seen, is_in_way),
        )
        return command, memory._replace(reaction=reaction)

    def _following(self, seen: Observation, is_in_way: BoolArray) -> FloatArray:
        """Acceleration that keeps the headway to a moving leader [m/s^2]; infinite if no leader is in the way."""
        gap = np.where(is_in_way, seen.gap, 0.0)
        gap_control = KEEPING_GAINS[0] * (seen.obstacle_speed - seen.speed) + KEEPING_GAINS[1] * (
            gap - self.headway * seen.speed
        )
        return np.where(is_in_way & (seen.obstacle_speed > 0), np.maximum(gap_control, -self.lets_go), np.inf)

    def _perceive(self, seen: Observation, memory: _Memory) -> tuple[BoolArray, _Memory]:
        """Whether the obstacle is perceived: it was in the way at first, or strayed from its first position
        `perception_time` ago.
        """
        is_sighted = np.isfinite(seen.gap) & np.isfinite(seen.lateral)
        lateral = np.where(is_sighted, seen.lateral, 0.0)
        appears = is_sighted & ~np.isfinite(memory.first_lateral)
        first_lateral = np.where(appears, lateral, memory.first_lateral)
        first_in_way = memory.first_in_way | (appears & (np.abs(lateral) <= self.corridor))
        deviation = np.abs(lateral - np.where(np.isfinite(first_lateral), first_lateral, 0.0))
        is_astray = is_sighted & (deviation >= self.stray)
        stray_time = np.where(
            memory.stray_time >= 0, memory.stray_time + memory.reaction.step, np.where(is_astray, 0.0, -1.0)
        )
        is_perceived = first_in_way | (stray_time >= self.perception_time - TIME_ROUNDING)
        return is_perceived, memory._replace(
            first_lateral=first_lateral, first_in_way=first_in_way, stray_time=stray_time
        )
