"""Commands of a controller that was written for SUMO, and the acceleration that SUMO's vehicle would then choose."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from safevar_sumo.errors import InputError

DRIVER_COMMANDS: Mapping[str, tuple[str]] = {
    "setAccel": ("accel",),
    "setDecel": ("decel",),
    "setEmergencyDecel": ("decel",),
    "setMaxSpeed": ("speed",),
    "setTau": ("tau",),
    "setMinGap": ("minGap",),
    "setSpeedFactor": ("factor",),
}
"""Commands that change attributes of SUMO's driver: SUMO carries them out."""
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "setSpeed": ("speed",),
    "slowDown": ("speed", "duration"),
    "setAcceleration": ("acceleration", "duration"),
    "setSpeedMode": ("mode",),
    "setLaneChangeMode": ("mode",),
    "setImperfection": ("imperfection",),
    **DRIVER_COMMANDS,
}
"""The commands that a controller may give, each with its numeric arguments."""
SUMO_CONTROL = -1.0
"""Value of a speed or speed mode with which a command returns control to SUMO's own driver."""
LEGAL_NUMBERS = (
    "a finite number from 0 on; any acceleration; a whole mode up to 127; speed or mode -1 for SUMO's driver"
)
OWN_LANE_CHANGES = 0b11111111
"""Bits of a lane change mode with which SUMO's driver changes lanes of his own accord."""
TICKS = 1000
"""SUMO counts time in thousandths of a second [1/s]."""


class CommandedSpeed:
    """A controller's commands, and the acceleration that results from them under SUMO's speed modes.

    A command holds until the next one (`MSVehicle::Influencer`): from `setSpeed` on the speed is `_target`; with
    `setAcceleration` and `slowDown` it changes evenly, by `_rate`, until `_end`. Then SUMO's own driver takes over.
    """

    LIMIT_TO_SAFE_SPEED, LIMIT_ACCELERATION, LIMIT_DECELERATION, DEFAULT_MODE = 1, 2, 4, 31
    BEYOND_LIMIT = 64

    def __init__(self, step: float) -> None:
        self._step = step
        self.mode = self.DEFAULT_MODE
        self._target = 0.0
        self._rate = math.inf
        self._end = -math.inf

    def command(self, name: str, time: float, speed: float, values: tuple[Any, ...]) -> None:
        """Process a command at a time [s] and speed [m/s]; raises `InputError` if an argument is no legal number."""
        for argument, number in zip(COMMANDS[name], values, strict=True):
            returns_control = number == SUMO_CONTROL and name in ("setSpeed", "setSpeedMode")
            is_legal = math.isfinite(number) and (number >= 0 or argument == "acceleration" or returns_control)
            if not is_legal or (name == "setSpeedMode" and number not in range(-1, 128)):
                raise InputError(f"traci.vehicle.{name}", f"{argument} = {number!r}", LEGAL_NUMBERS)
        value, *durations = map(float, values)
        if name == "setImperfection" and value:
            raise InputError("traci.vehicle.setImperfection", f"imperfection = {value:g} makes results random", "0")
        if name == "setLaneChangeMode" and int(value) & OWN_LANE_CHANGES:
            problem = f"mode = {value:g}: the vehicle keeps its lane"
            raise InputError("traci.vehicle.setLaneChangeMode", problem, "0, 256 or 512, without changes of lane")
        if name == "setSpeedMode":
            self.mode = self.DEFAULT_MODE if value == SUMO_CONTROL else int(value)
        elif name == "setSpeed":
            self._target = value
            self._rate = math.inf
            self._end = -math.inf if value == SUMO_CONTROL else math.inf
        elif durations:
            duration = math.floor(durations[0] * TICKS + 0.5) / TICKS
            self._target = value if name == "slowDown" else max(speed + value * duration, 0.0)
            self._rate = abs(self._target - speed) / max(duration, self._step)
            self._end = time + duration

    def acceleration(self, speed: float, time: float, sumo_speed: float, accel: float, decel: float) -> float:
        """The acceleration by the commands [m/s^2].

        SUMO's own driver would choose `sumo_speed` next [m/s]; `accel` and `decel` are its limits [m/s^2].
        """
        change = self._target - speed
        if time > self._end + 0.5 / TICKS:
            return (sumo_speed - speed) / self._step
        change = math.copysign(min(abs(change), self._rate * self._step), change)
        if self.mode & self.LIMIT_TO_SAFE_SPEED:
            change = min(change, sumo_speed - speed)
        if self.mode & self.LIMIT_ACCELERATION:
            change = min(change, accel * self._step)
        if self.mode & self.LIMIT_DECELERATION:
            change = max(change, -decel * self._step)
        return change / self._step
