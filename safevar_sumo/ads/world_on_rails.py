"""World On Rails (Chen, Koltun, Kraehenbuehl 2021): an end-to-end vision policy at 20 Hz."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.base import Ads
from safevar_sumo.ads.driver import DelayLine
from safevar_sumo.records import KMH_PER_MS, BoolArray, Command, FloatArray, Nominal, Observation

UpTo60 = Annotated[float, Meta(ge=0, le=60)]
Throttle = Annotated[float, Meta(ge=0, le=1)]
Delay = Annotated[float, Meta(ge=0, le=5)]
SPEED_LIMIT = 20 / KMH_PER_MS
"""Speed above which the agent releases the throttle [m/s] (20 km/h in its source code)."""
SPEED_LEVELS = (0.0, 8 / 3, 16 / 3)
"""The first three of the four speed levels in the policy's source code, 0 to 8 m/s; between them the throttle is linear
in speed.
"""
PASSED_GAP = -0.5
"""Gap at which an obstacle is beside the vehicle rather than ahead [m]; the policy does not begin to brake for it."""
RELEASE_GAP = -1.0
"""Once braking, the policy brakes until the obstacle is this far behind the front bumper [m]."""


class _Memory(NamedTuple):
    """Whether the policy brakes; commands not yet carried out, newest last; delay lines.

    `recognition_line` delays gap and lateral position, `hesitation_line` the brake command.
    """

    is_braking: BoolArray
    pending_commands: tuple[Command, ...]
    recognition_line: DelayLine
    hesitation_line: DelayLine


class WorldOnRails(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Full brake for a near obstacle in its corridor, else throttle up to its speed limit.

    Parameters
    ----------
    first_command
        Time from the start of the run to the first throttle of a standing vehicle [s].
    latency
        Time from an image to its command [s], rounded to whole steps.
    corridor
        Half the width of the corridor in which the policy brakes for obstacles; it releases the brake when they leave
        the corridor [m].
    brake_gap, brake_gap_per_speed
        The policy brakes at gaps up to `brake_gap` + `brake_gap_per_speed` * speed [m, s] for an obstacle at the
        lateral position `brake_place`.
    brake_place
        Lateral position of an obstacle for which the policy brakes earliest [m], negative on the side that it comes
        from.
    brake_gap_before, brake_gap_past
        Slopes [-]: the braking gap shrinks by `brake_gap_before` for each metre that the obstacle is short of
        `brake_place`, and by `brake_gap_past` for each metre past it, so that the policy brakes later for obstacles
        that enter or leave its path. The visibility multiplies the remaining gap.
    throttle
        Throttle at the policy's speed levels 0, 2.7 and 5.3 m/s.
    recognition_delay
        Additional time to recognise an obstacle, compared with clear weather [s].
    hesitation
        Time between releasing the accelerator and braking, while the policy is not yet sure [s]. It releases the brake
        at once.
    """

    first_command: UpTo60
    latency: UpTo60
    corridor: UpTo60
    brake_gap: float
    brake_gap_per_speed: float
    brake_place: float
    brake_gap_before: UpTo60
    brake_gap_past: UpTo60
    throttle: tuple[Throttle, Throttle, Throttle]
    recognition_delay: Delay = 0.0
    hesitation: Delay = 0.0

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        idle = Command(np.zeros(n), np.zeros(n))
        return _Memory(
            np.zeros(n, dtype=bool),
            (idle,) * round(self.latency / step),
            DelayLine.by(self.recognition_delay, step),
            DelayLine.by(self.hesitation, step),
        )

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        (gap, lateral), recognition_line = memory.recognition_line.delayed(np.array([seen.gap, seen.lateral]))
        is_braking = self._decide_to_brake(seen, gap, lateral, memory.is_braking)
        is_waiting = (seen.speed == 0) & (seen.time < self.first_command)
        throttle = np.where(is_braking | is_waiting | (seen.speed > SPEED_LIMIT), 0.0, self._throttle(seen.speed))
        command, *pending_commands = (*memory.pending_commands, Command(throttle, is_braking.astype(float)))
        delayed_brake, hesitation_line = memory.hesitation_line.delayed(command.brake)
        memory = _Memory(is_braking, tuple(pending_commands), recognition_line, hesitation_line)
        return Command(command.throttle, np.minimum(command.brake, delayed_brake)), memory

    def _decide_to_brake(
        self, seen: Observation, gap: FloatArray, lateral: FloatArray, was_braking: BoolArray
    ) -> BoolArray:
        """Whether the recognised obstacle is near and in the corridor; then the policy's probability of braking exceeds
        one half.
        """
        offset = lateral - self.brake_place
        reduction = self.brake_gap_past * np.maximum(offset, 0.0) + self.brake_gap_before * np.maximum(-offset, 0.0)
        braking_gap = seen.visibility * (self.brake_gap + self.brake_gap_per_speed * seen.speed - reduction)
        is_in_corridor = np.abs(lateral) <= self.corridor
        starts_braking = is_in_corridor & (gap <= braking_gap) & (gap > PASSED_GAP)
        keeps_braking = is_in_corridor & was_braking & (gap > RELEASE_GAP)
        is_braking: BoolArray = starts_braking | keeps_braking
        return is_braking

    def _throttle(self, speed: FloatArray) -> FloatArray:
        low, middle, high = self.throttle
        level = speed / SPEED_LEVELS[1]
        upper = middle + (high - middle) * np.minimum(np.maximum(level - 1, 0.0), 1.0)
        return np.asarray(np.where(level < 1, low + (middle - low) * level, upper))
