"""Car-following models as drivers: an acceleration from gap and speeds, through the pedals; somebody beside the way is no leader."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec import Struct

from safevar_sumo.ads.pedals import Trim, pedals, trim
from safevar_sumo.ads.reaction import FARTHEST, in_the_way
from safevar_sumo.records import Command, FloatArray, Nominal, Observation


class Memory(NamedTuple):
    """The original vehicle; time between calls [s]; trim of the pedals, of the first look."""

    nominal: Nominal
    step: float
    trimmed: Trim | None


class Following(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of a driver with a law of its own.

    Parameters
    ----------
    corridor
        Half the width of its way [m].
    """

    corridor: float

    def start(self, n: int, nominal: Nominal, step: float) -> Memory:
        return Memory(nominal, step, None)

    def drive(self, seen: Observation, memory: Memory) -> tuple[Command, Memory]:
        trimmed = trim(memory.nominal, seen) if memory.trimmed is None else memory.trimmed
        gap = np.where(in_the_way(seen, self.corridor), seen.gap, FARTHEST)
        wanted = self.acceleration_at(gap, seen.speed, seen.obstacle_speed)
        return pedals(memory.nominal, seen.speed, wanted, trimmed), memory._replace(trimmed=trimmed)

    def acceleration_at(self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """Acceleration asked for [m/s^2] at a gap from bumper to bumper [m] and speeds [m/s], shape (N,)."""
        raise NotImplementedError
