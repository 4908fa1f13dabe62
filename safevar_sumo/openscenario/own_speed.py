"""Ego's own speeds in a file: what a robot drives until the driving system is switched on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from safevar_sumo.openscenario.actors import STEP, Actor, Array
from safevar_sumo.openscenario.document import unsupported


@dataclass
class OwnSpeeds:
    """The speeds of Ego by its SpeedActions: when the last of them ends, and when an
    ActivateControllerAction switches the driving system on [s].
    """

    until: float = 0.0
    switched_on: float = math.inf

    def begin(self, now: float, duration: float, name: str) -> None:
        """Begin a SpeedAction; one of Init that takes no time is no profile."""
        if now >= self.switched_on:
            raise unsupported(
                f"SpeedAction of {name} after the start: its driving system drives from"
                f" {self.switched_on:.1f} s on",
                "a SpeedAction before an ActivateControllerAction",
            )
        if math.isfinite(duration) and (now or duration):
            self.until = now + duration

    def end(self, now: float) -> None:
        """Switch the driving system on."""
        if not now and self.until:
            raise unsupported(
                "SpeedAction of Ego that takes time, beside an ActivateControllerAction in Init",
                "an ActivateControllerAction in an event after it",
            )
        self.switched_on = min(now, self.switched_on)

    @property
    def end_time(self) -> float:
        """When the robot ends [s]; 0 without a profile."""
        end = self.until if math.isinf(self.switched_on) else self.switched_on
        return end if self.until else 0.0

    def speeds(self, ego: Actor, last: int) -> Array:
        """Speeds at all samples up to the end of the profile, one of them without a profile.

        After them Ego keeps its speed.
        """
        end = min(math.ceil(self.end_time / STEP - 1e-6), last)
        speeds = ego.speed[: end + 1]
        if speeds[-1] <= 0:
            when = f"when its driving system is switched on, at {end * STEP:.1f} s"
            raise unsupported(
                f"{ego.name} stands {when if end else 'at the start'}", "a SpeedAction in Init"
            )
        if np.ptp(ego.speed[end : last + 1]) > 1e-6:
            raise unsupported(
                f"{ego.name} does not keep its speed at the start: its driving system drives",
                "a SpeedAction",
            )
        return speeds
