"""World On Rails (Chen, Koltun, Kraehenbuehl 2021): an end-to-end vision policy at 20 Hz."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from msgspec import Struct

from safevar_sumo.records import Command, FloatArray, Nominal, Observation

SPEED_LIMIT = 20 / 3.6
"""Above this speed the agent releases the throttle [m/s] (its source, 20 km/h)."""


class _Memory(NamedTuple):
    nothing: FloatArray


class WorldOnRails(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Full brake when it sees somebody in its corridor and near, else throttle.

    Parameters
    ----------
    corridor
        Half the width of what it takes for its way [m].
    gap_standing, gap_time
        It brakes at gaps up to `gap_standing` + `gap_time` * speed [m, s], in clear weather.
    throttle
        What it commands below its speed limit, else 0.
    """

    corridor: float = 2.0
    gap_standing: float = 4.0
    gap_time: float = 0.7
    throttle: float = 0.7

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        return _Memory(np.zeros(n))

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        near = seen.gap <= seen.visibility * (self.gap_standing + self.gap_time * seen.speed)
        brakes = near & (np.abs(seen.lateral) <= self.corridor) & (seen.gap > -1)
        brake = np.where(brakes, 1.0, memory.nothing)
        throttle = np.where(brakes | (seen.speed > SPEED_LIMIT), 0.0, self.throttle)
        return Command(throttle, brake), memory
