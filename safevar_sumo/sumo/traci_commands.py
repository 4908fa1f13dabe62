"""The TraCI functions that a controller written for SUMO may call; its commands are among them. And
the acceleration that SUMO's vehicle would choose under these commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from safevar_sumo.errors import InputError

DRIVER_COMMANDS: Mapping[str, tuple[str, ...]] = {
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
"""The commands that a controller may give, with the names of their numeric arguments."""
LISTS = ("getIDList", "getIDCount")
POSITIONS = ("getPosition", "getPosition3D")
MOTION = (
    *POSITIONS,
    "getSpeed",
    "getAngle",
    "getRoadID",
    "getLaneID",
    "getLanePosition",
)
SENSED: Mapping[str, tuple[str, ...]] = {
    "vehicle": (
        *MOTION,
        "getLaneIndex",
        "getAcceleration",
        "getLateralSpeed",
        "getLateralLanePosition",
        "getSignals",
    ),
    "person": MOTION,
}
"""Functions, by domain, that return values of other actors that sensors can measure."""
TYPE_PROPERTIES = (
    "getLength",
    "getWidth",
    "getHeight",
    "getMinGap",
    "getVehicleClass",
    "getAccel",
    "getDecel",
    "getEmergencyDecel",
    "getMaxSpeed",
    "getTau",
    "getMass",
)
CONSTANT = ("getTypeID", *TYPE_PROPERTIES)
"""Functions that return properties of actors that never change: they follow from the actor's type,
so that they need no sensor.
"""
OWN = (
    "getLeader",
    "getRoute",
    "getRouteID",
    "getRouteIndex",
    "getDistance",
    "getDrivingDistance",
    "getAllowedSpeed",
    "getSpeedMode",
    "getWaitingTime",
    "getNextTLS",
    "getFollowSpeed",
    "getSecureGap",
    "getStopSpeed",
)
"""Functions that a controller may call for the vehicle under test, but for no other actor."""
SUBSCRIPTIONS = ("subscribe", "getSubscriptionResults", "getAllSubscriptionResults")
CALLS: Mapping[str, tuple[str, ...]] = {
    "vehicle": (*LISTS, *SENSED["vehicle"], *CONSTANT, *OWN, *COMMANDS, *SUBSCRIPTIONS),
    "person": (*LISTS, *MOTION, *CONSTANT, *SUBSCRIPTIONS),
    "simulation": (
        "getTime",
        "getDeltaT",
        "getDistance2D",
        "getDistanceRoad",
        "convert2D",
        "convertGeo",
        "convertRoad",
    ),
    "edge": (*LISTS, "getLaneNumber", "getFromJunction", "getToJunction", "getAngle"),
    "lane": (
        *LISTS,
        "getEdgeID",
        "getLength",
        "getWidth",
        "getShape",
        "getMaxSpeed",
        "getAllowed",
        "getDisallowed",
        "getLinkNumber",
        "getLinks",
        "getFoes",
    ),
    "junction": (*LISTS, "getPosition", "getShape"),
    "trafficlight": (
        *LISTS,
        "getRedYellowGreenState",
        "getPhase",
        "getPhaseDuration",
        "getNextSwitch",
        "getProgram",
        "getControlledLanes",
        "getControlledLinks",
    ),
    "vehicletype": (*LISTS, *TYPE_PROPERTIES),
    "route": (*LISTS, "getEdges"),
}
"""The functions that a controller may call, by domain."""
VARIABLES: Mapping[str, str] = {
    "VAR_POSITION": "getPosition",
    "VAR_POSITION3D": "getPosition3D",
    "VAR_SPEED": "getSpeed",
    "VAR_ANGLE": "getAngle",
    "VAR_ROAD_ID": "getRoadID",
    "VAR_LANE_ID": "getLaneID",
    "VAR_LANE_INDEX": "getLaneIndex",
    "VAR_LANEPOSITION": "getLanePosition",
    "VAR_LANEPOSITION_LAT": "getLateralLanePosition",
    "VAR_SPEED_LAT": "getLateralSpeed",
    "VAR_ACCELERATION": "getAcceleration",
    "VAR_SIGNALS": "getSignals",
    "VAR_LEADER": "getLeader",
    "VAR_DISTANCE": "getDistance",
    "VAR_ALLOWED_SPEED": "getAllowedSpeed",
    "VAR_LENGTH": "getLength",
    "VAR_WIDTH": "getWidth",
    "VAR_TYPE": "getTypeID",
    "VAR_MAXSPEED": "getMaxSpeed",
}
"""TraCI's variables for subscriptions, by name, with the function that returns the same value."""
DEFAULT_VARIABLES = ("VAR_ROAD_ID", "VAR_LANEPOSITION")
SUMO_CONTROL = -1.0
"""Value of a speed or speed mode with which a command returns control to SUMO's own driver."""
LEGAL_NUMBERS = (
    "a finite number from 0 on; any acceleration; a whole mode up to 127; speed or mode -1 for"
    " SUMO's driver"
)
OWN_LANE_CHANGES = 0b11111111
"""Bits of a lane change mode that let SUMO's driver change lanes of his own accord."""
TICKS = 1000
"""SUMO counts time in thousandths of a second [1/s]."""


class CommandedSpeed:
    """The current command of a controller, and the acceleration that results from it under SUMO's
    speed modes.

    A command holds until the next command (`MSVehicle::Influencer`). After `setSpeed` the speed
    becomes `_target` [m/s] at once. After `setAcceleration` or `slowDown` the speed changes towards
    `_target` evenly, by `_rate` [m/s^2], until the time `_end` [s]; then SUMO's own driver takes
    over.
    """

    LIMIT_TO_SAFE_SPEED = 1
    LIMIT_ACCELERATION = 2
    LIMIT_DECELERATION = 4
    DEFAULT_MODE = 31
    BEYOND_LIMIT = 64

    def __init__(self, step: float) -> None:
        self._step = step
        self.mode = self.DEFAULT_MODE
        self._target = 0.0
        self._rate = math.inf
        self._end = -math.inf

    def command(
        self, name: str, time: float, speed: float, values: tuple[Any, ...]
    ) -> None:
        """Process a command that the controller gives at this time [s] and speed [m/s]. Raises an
        InputError if an argument is no legal number.
        """
        for argument, number in zip(COMMANDS[name], values, strict=True):
            returns_control = number == SUMO_CONTROL and name in (
                "setSpeed",
                "setSpeedMode",
            )
            is_legal = math.isfinite(number) and (
                number >= 0 or argument == "acceleration" or returns_control
            )
            if not is_legal or (
                name == "setSpeedMode" and number not in range(-1, 128)
            ):
                raise InputError(
                    f"traci.vehicle.{name}", f"{argument} = {number!r}", LEGAL_NUMBERS
                )

        # Random results could not be repeated, and the vehicle models know only one lane.
        value, *durations = (float(value) for value in values)
        if name == "setImperfection" and value:
            raise InputError(
                "traci.vehicle.setImperfection",
                f"imperfection = {value:g} makes results random",
                "0",
            )
        if name == "setLaneChangeMode" and int(value) & OWN_LANE_CHANGES:
            raise InputError(
                "traci.vehicle.setLaneChangeMode",
                f"mode = {value:g}: the vehicle keeps its lane",
                "0, 256 or 512, without changes of lane",
            )

        if name == "setSpeedMode":
            self.mode = self.DEFAULT_MODE if value == SUMO_CONTROL else int(value)
        elif name == "setSpeed":
            self._target = value
            self._rate = math.inf
            self._end = -math.inf if value == SUMO_CONTROL else math.inf
        elif durations:
            duration = math.floor(durations[0] * TICKS + 0.5) / TICKS
            self._target = (
                value if name == "slowDown" else max(speed + value * duration, 0.0)
            )
            self._rate = abs(self._target - speed) / max(duration, self._step)
            self._end = time + duration

    def acceleration(
        self, speed: float, time: float, sumo_speed: float, accel: float, decel: float
    ) -> float:
        """The acceleration that the current command asks for [m/s^2].

        `sumo_speed` is the speed that SUMO's own driver would choose for the next step [m/s];
        `accel` and `decel` are the limits of this driver [m/s^2].
        """
        # After the end of the command SUMO's own driver chooses the speed.
        change = self._target - speed
        if time > self._end + 0.5 / TICKS:
            return (sumo_speed - speed) / self._step

        # At most as fast as the command, and within the limits of the speed mode.
        change = math.copysign(min(abs(change), self._rate * self._step), change)
        if self.mode & self.LIMIT_TO_SAFE_SPEED:
            change = min(change, sumo_speed - speed)
        if self.mode & self.LIMIT_ACCELERATION:
            change = min(change, accel * self._step)
        if self.mode & self.LIMIT_DECELERATION:
            change = max(change, -decel * self._step)
        return change / self._step
