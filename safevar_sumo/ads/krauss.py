"""SUMO's default car-following model as an ADS (Krauss 1998; SUMO `MSCFModel_Krauss`)."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.base import Ads
from safevar_sumo.ads.driver import LARGEST_GAP
from safevar_sumo.records import Command, Nominal, Observation


class _Memory(NamedTuple):
    """The original vehicle and the time between two calls [s]."""

    nominal: Nominal
    step: float


class Krauss(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Never drives faster than a speed from which the original vehicle can stop behind the obstacle after a reaction
    time.

    Parameters
    ----------
    cruise_speed
        Desired speed [m/s].
    standing_gap
        Intended gap at standstill [m].
    braking_share
        Planned deceleration as a share of the original vehicle's greatest deceleration [-].
    reaction_time
        Planned time until braking begins [s].
    """

    cruise_speed: Annotated[float, Meta(gt=0)] = 13.89
    standing_gap: Annotated[float, Meta(ge=0)] = 2.5
    braking_share: Annotated[float, Meta(gt=0, le=1)] = 0.6
    reaction_time: Annotated[float, Meta(ge=0)] = 1.0

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        return _Memory(nominal, step)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        """Aim at v_safe = -b t + sqrt((b t)^2 + 2 b gap), with the planned deceleration b and the reaction time t.

        From v_safe the vehicle comes to rest behind a standing obstacle.
        """
        nominal = memory.nominal
        deceleration = self.braking_share * nominal.decel
        reaction_speed = deceleration * self.reaction_time
        gap = np.minimum(np.maximum(seen.gap - self.standing_gap, 0.0), LARGEST_GAP)
        safe_speed = np.sqrt(reaction_speed * reaction_speed + 2 * deceleration * gap) - reaction_speed
        acceleration = (np.minimum(safe_speed, self.cruise_speed) - seen.speed) / (memory.step + nominal.actuator_lag)
        throttle = np.minimum(np.maximum(acceleration / nominal.accel, 0.0), 1.0)
        brake = np.minimum(np.maximum(-acceleration / nominal.decel, 0.0), 1.0)
        return Command(throttle, brake), memory
