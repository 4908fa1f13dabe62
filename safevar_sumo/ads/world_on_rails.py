"""World On Rails (Chen, Koltun, Kraehenbuehl 2021): an end-to-end vision policy at 20 Hz."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.driver import Late
from safevar_sumo.records import KMH, BoolArray, Command, FloatArray, Nominal, Observation

NotNegative = Annotated[float, Meta(ge=0, le=60)]
Throttle = Annotated[float, Meta(ge=0, le=1)]
Reaction = Annotated[float, Meta(ge=0, le=5)]
SPEED_LIMIT = 20 / KMH
"""Above this speed the agent releases the throttle [m/s] (its source, 20 km/h)."""
SPEED_LEVELS = (0.0, 8 / 3, 16 / 3)
"""Speeds that the policy is interpolated over, as far as the limit lets it [m/s] (its source: four in 0..8 m/s)."""
PASSED = -0.5
"""Gap at which an obstacle is beside the vehicle rather than ahead [m]."""


class _Memory(NamedTuple):
    """Whether it brakes; commands on their way, newest last; gap and lateral place, and the brake that it wants, on theirs."""

    brakes: BoolArray
    under_way: tuple[Command, ...]
    recognised: Late
    braked: Late


class WorldOnRails(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Full brake for a near obstacle in its corridor, else throttle up to its speed limit.

    Parameters
    ----------
    first_command
        Time from the run's start to the first throttle, of a vehicle that stands [s].
    latency
        Time from an image to its command [s], rounded to whole steps.
    corridor
        Half the width of the corridor in which it brakes for obstacles; it releases the brake when they leave it [m].
    brake_gap, brake_gap_per_speed
        It brakes at gaps up to `brake_gap` + `brake_gap_per_speed` * speed [m, s] for an obstacle at `brake_place`.
    brake_place, brake_gap_before, brake_gap_past
        For every metre that an obstacle is short of that lateral place, or past it, the gap shrinks by as much [m, -, -]: it brakes
        later for obstacles that enter or leave the way. The visibility is a factor on the rest.
    throttle
        Throttle at the policy's speed levels 0, 2.7 and 5.3 m/s.
    recognition_delay
        By how much later than in clear weather it makes somebody out [s].
    hesitation
        By how much later than it lets go of the accelerator it then brakes [s]: it is not sure yet. It lets go of the brake at once.
    """

    first_command: NotNegative
    latency: NotNegative
    corridor: NotNegative
    brake_gap: float
    brake_gap_per_speed: float
    brake_place: float
    brake_gap_before: NotNegative
    brake_gap_past: NotNegative
    throttle: Annotated[tuple[Throttle, Throttle, Throttle], Meta()]
    recognition_delay: Reaction = 0.0
    hesitation: Reaction = 0.0

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        idle = Command(np.zeros(n), np.zeros(n))
        return _Memory(np.zeros(n, dtype=bool), (idle,) * round(self.latency / step), Late.by(self.recognition_delay, step),
                       Late.by(self.hesitation, step))

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        (gap, lateral), recognised = memory.recognised.shown(np.stack([seen.gap, seen.lateral]))
        brakes = self._brakes(seen._replace(gap=gap, lateral=lateral), memory.brakes)
        waits = (seen.speed == 0) & (seen.time < self.first_command)
        throttle = np.where(brakes | waits | (seen.speed > SPEED_LIMIT), 0.0, self._throttle(seen.speed))
        command, *under_way = (*memory.under_way, Command(throttle, np.where(brakes, 1.0, 0.0)))
        sure, braked = memory.braked.shown(command.brake)
        return Command(command.throttle, np.minimum(command.brake, sure)), _Memory(brakes, tuple(under_way), recognised, braked)

    def _brakes(self, seen: Observation, braked: BoolArray) -> BoolArray:
        """Whether the brake probability exceeds one half: an obstacle is near, in the corridor."""
        past = seen.lateral - self.brake_place
        aside = self.brake_gap_past * np.maximum(past, 0.0) + self.brake_gap_before * np.maximum(-past, 0.0)
        near = seen.visibility * (self.brake_gap + self.brake_gap_per_speed * seen.speed - aside)
        watched = np.abs(seen.lateral) <= self.corridor
        begins = watched & (seen.gap <= near) & (seen.gap > PASSED)
        goes_on = watched & braked & (seen.gap > 2 * PASSED)
        return np.asarray(begins | goes_on)

    def _throttle(self, speed: FloatArray) -> FloatArray:
        low, middle, high = self.throttle
        level = speed / SPEED_LEVELS[1]
        upper = middle + (high - middle) * np.minimum(np.maximum(level - 1, 0.0), 1.0)
        return np.asarray(np.where(level < 1, low + (middle - low) * level, upper))
