"""What a road that rises or falls does to whoever drives on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from safevar_sumo.records import BoolArray, Command, FloatArray, Observation

GRAVITY = 9.81
"""[m/s^2]"""


class Slope(NamedTuple):
    """Gravity on a road, for all vehicles or shape (N,) [m/s^2]: `back` against the way, negative downhill; `down` onto the road."""

    back: float | FloatArray
    down: float | FloatArray


LEVEL = Slope(0.0, GRAVITY)


def slope_of(grade: FloatArray) -> Slope:
    """The slope of a grade, rise over run [%]: g sin and g cos of the angle whose tangent that is."""
    rise = grade / 100
    length = np.sqrt(1 + rise * rise)
    return Slope(GRAVITY * (rise / length), GRAVITY / length)


Characteristics = Mapping[str, FloatArray]
"""Name -> values of N vehicles in the model's table units, each of shape (N,)."""


class SumoType(NamedTuple):
    """The attributes of N SUMO vehicle types, each of shape (N,): kg, m/s^2, m/s^2, m/s, s.

    `tau` is SUMO's desired headway; vehicles set their actuator lag there. SUMO's models do not drive the vehicle, so nothing acts on it.
    """

    mass: FloatArray
    accel: FloatArray
    decel: FloatArray
    max_speed: FloatArray
    tau: FloatArray


class VehicleState(Protocol):
    """What every model's state tells of N vehicles, each of shape (N,): m/s, -, -, -."""

    @property
    def speed(self) -> FloatArray: ...
    @property
    def throttle(self) -> FloatArray: ...
    @property
    def brake(self) -> FloatArray: ...
    @property
    def gear(self) -> FloatArray: ...


class Vehicle(Protocol):
    """A vehicle model. Its fields are the parameters that a study gives under `vehicle.parameters`.

    Every method is a pure function over arrays of N vehicles: element i of a result depends on
    element i of the arguments alone, to the bit. So methods use only + - * / and square roots,
    comparisons, minima and maxima: those are exact on every machine and for every N.

    It may have `hold_gear(prepared, state, holds)`, the state in which the vehicles that `holds`, of shape (N,), do not change gear
    and the others do by themselves: a driver needs it who holds the speed of a test. It may have `FITTED_UP_TO`, the fastest speed
    that its parameters were identified at [m/s].
    """

    UNITS: Mapping[str, str]

    def prepare(self, characteristics: Characteristics, road_friction: float, step: float, slope: Slope = LEVEL,
                wet: bool | BoolArray = False) -> Any:
        """Everything that stays the same in a run, `step` seconds a step, once computed.

        `road_friction` is the weather's factor on the tyres' friction, `wet` whether the road is wet, for vehicles on which water acts
        beyond that factor. A vehicle whose method takes no `slope` drives on level roads only; one that takes no `wet` is not told.
        """

    def sumo_type(self, prepared: Any) -> SumoType:
        """The SUMO vehicle types that these vehicles are."""

    def at_rest(self, prepared: Any) -> Any:
        """The state at the start: standing, pedals released."""

    def at_speed(self, prepared: Any, speed: FloatArray) -> Any:
        """The steady state at a speed above 0 [m/s], shape (N,): with the pedals kept where they are nothing changes."""

    def sense(self, prepared: Any, state: Any, seen: Observation) -> tuple[Observation, Any]:
        """What the vehicles' own sensors leave of an observation, and the state after it."""

    def advance(self, prepared: Any, state: Any, command: Command) -> Any:
        """The state one simulation step later."""


def at_start(vehicle: Vehicle, prepared: Any, speed: FloatArray) -> Any:
    """The state of vehicles that the traffic puts onto the road with `speed` [m/s], shape (N,): at rest, or steady."""
    rest = vehicle.at_rest(prepared)
    rolls = speed > 0
    if not rolls.any():
        return rest
    steady = vehicle.at_speed(prepared, np.where(rolls, speed, 1.0))
    if rolls.all():
        return steady
    return type(rest)(*(one if one is None else np.where(rolls, one, other) for one, other in zip(steady, rest, strict=True)))
