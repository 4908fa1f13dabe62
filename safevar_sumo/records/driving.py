"""What passes between the vehicles and their driving system: observations, commands, and the original vehicle as an ADS
knows it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from safevar_sumo.records.base import ZERO, FloatArray


class Observation(NamedTuple):
    """Sensor values of N vehicles; every array has shape (N,).

    `gap` is the distance along the vehicle's path from its front bumper to the obstacle, infinite
    while the obstacle is not detected [m]; `lateral` is the obstacle's offset from the middle of the
    vehicle's lane, negative on the side that the obstacle comes from, infinite while it is out of sight [m].
    `closing_speed` is the rate at which the gap shrinks, `obstacle_speed` the obstacle's own speed along the vehicle's
    path [m/s]; `throttle` and `brake` are the pedals' positions [-].
    """

    time: float
    speed: FloatArray
    gap: FloatArray
    closing_speed: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    visibility: float | FloatArray
    obstacle_speed: FloatArray = ZERO
    throttle: FloatArray = ZERO
    brake: FloatArray = ZERO


class Command(NamedTuple):
    """Pedals that the ADS of N vehicles commands, each in [0, 1], shape (N,)."""

    throttle: FloatArray
    brake: FloatArray


class PedalTables(NamedTuple):
    """The effect of the original vehicle's pedals on a dry road, at `speeds` [m/s].

    `full_throttle` is the acceleration at full throttle, `coasting` the deceleration without pedals [m/s^2]; `braking`
    is the deceleration that the brake adds per unit of pedal, far from the limit of the tyres [m/s^2].
    """

    speeds: FloatArray
    full_throttle: FloatArray
    coasting: FloatArray
    braking: float


class Nominal(NamedTuple):
    """The original vehicle on a dry road: all that an ADS knows of the vehicle.

    `mass` [kg], `accel`, `decel` [m/s^2] and `max_speed` [m/s] are values of its SUMO type; `actuator_lag` [s] is the
    time constant with which its wheels follow the pedals (`tau` of its SUMO type). `tables` drives the vehicle on its
    first call, and returns `speeds`, `full_throttle`, `coasting` and `braking`.
    """

    mass: float
    accel: float
    decel: float
    max_speed: float
    actuator_lag: float
    tables: Callable[[], PedalTables]

    @property
    def speeds(self) -> FloatArray:
        return self.tables().speeds

    @property
    def full_throttle(self) -> FloatArray:
        return self.tables().full_throttle

    @property
    def coasting(self) -> FloatArray:
        return self.tables().coasting

    @property
    def braking(self) -> float:
        return self.tables().braking
