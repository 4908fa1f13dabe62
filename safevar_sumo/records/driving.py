"""Types of quantities, constants, and records of what a vehicle's driving system observes and
commands.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int_]
TextArray = npt.NDArray[np.str_]
FloatOrArray = float | FloatArray
Quantity = Any
"""A number, or an array of numbers. Its shape broadcasts to that of N vehicles, or of T samples of
N encounters.
"""
NamedValues = dict[str, float]
"""Numbers by name, such as the values of characteristics."""
JsonObject = dict[str, Any]
"""An object of JSON, or a table of TOML: plain values by their keys."""

STANDSTILL = 1e-3
"""Speed below which a vehicle counts as standing [m/s] (method section 4)."""
KMH_PER_MS = 3.6
"""Number of km/h in 1 m/s."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
TIME_ROUNDING = 1e-9
"""Difference below which two sums of time steps count as the same time [s]."""
TOUCH_OVERLAP = 2e-3
"""Largest overlap of bodies that only touch [m]. SUMO ignores an overlap of a millimetre."""
LEAST_COLLISION_SPEED = 1e-3
"""Least closing speed of a collision [m/s]. The safety degree of a collision is minus its closing
speed, and must be below 0 even if the struck body is faster than the vehicle.
"""
LENGTH_DECIMALS = 9
"""Decimals to which differences of distances are rounded, so that 4.7 m is not 4.699999999999996
m.
"""
TIME_DECIMALS = 9
"""Decimals to which sums of time steps are rounded, so that 0.15 s is not 0.15000000000000002 s."""
ZERO: FloatArray = np.zeros(())
"""The scalar zero, which broadcasts to all N vehicles."""
ALL_TRUE: BoolArray = np.ones((), bool)
"""The scalar True, which broadcasts to all N vehicles."""
UNDEFINED: FloatArray = np.array(np.nan)
"""The scalar NaN, which broadcasts to all N vehicles."""
for _constant in (ZERO, ALL_TRUE, UNDEFINED):
    _constant.flags.writeable = False


def nans(shape: int | tuple[int, ...]) -> FloatArray:
    """An array of NaN, which stands for undefined values."""
    return np.full(shape, np.nan)


def clip_to_share(values: FloatOrArray) -> FloatArray:
    """Values that are limited to the range of a share: from 0 to 1 [-]."""
    return np.minimum(np.maximum(values, 0.0), 1.0)


def finite_or_none(value: float) -> float | None:
    """Convert a number for JSON. JSON has neither NaN nor infinities: these become None."""
    if not np.isfinite(value):
        return None
    return float(value)


LARGE = 100_000
"""From here on, a rounded number has an exponent."""


def significant(value: float, digits: int) -> str:
    """A number for readers, with `digits` significant digits. A number below `LARGE` keeps the
    other digits before its decimal point, so that it has no exponent such as in `1.23e+03`.
    """
    text = f"{value:.{digits}g}"
    if "e+" in text and abs(value) < LARGE:
        return f"{value:.0f}"
    return text


class Observation(NamedTuple):
    """What the sensors of N vehicles observe. Every array has shape (N,), or broadcasts to it.

    Attributes
    ----------
    time
        Time since the start of the run [s].
    speed
        The vehicle's own speed [m/s].
    gap
        Distance along the vehicle's path from the front bumper to the obstacle [m]; infinite while
        no obstacle is detected.
    closing_speed
        Speed at which the gap shrinks [m/s].
    lateral
        Distance of the obstacle from the middle of the vehicle's lane [m], negative on the side
        from which the obstacle comes; infinite while the obstacle is out of sight.
    lateral_speed
        Speed at which `lateral` changes [m/s].
    visibility
        Factor on the range of the sensors [-].
    obstacle_speed
        The obstacle's own speed along the vehicle's path [m/s].
    throttle, brake
        Positions of the pedals [-].
    obstacle_width, obstacle_length
        The obstacle's extent across and along the lane [m]; 0 if the scenario does not state it.
    obstacle
        The number of the body that is the obstacle, if the scenario has several bodies.
    """

    time: float
    speed: FloatArray
    gap: FloatArray
    closing_speed: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    visibility: FloatOrArray
    obstacle_speed: FloatArray = ZERO
    throttle: FloatArray = ZERO
    brake: FloatArray = ZERO
    obstacle_width: FloatArray = ZERO
    obstacle: FloatArray = ZERO
    obstacle_length: FloatArray = ZERO


class Command(NamedTuple):
    """The pedals that the ADS of N vehicles commands, each in [0, 1], shape (N,)."""

    throttle: FloatArray
    brake: FloatArray


class PedalTables(NamedTuple):
    """The effect of the original vehicle's pedals on a dry road, at certain `speeds` [m/s].

    `full_throttle` is the acceleration at full throttle, and `coasting` the deceleration without
    pedals [m/s^2]. `braking` is the deceleration that the brake adds for each unit of pedal
    [m/s^2], if tyres do not limit the brake force.
    """

    speeds: FloatArray
    full_throttle: FloatArray
    coasting: FloatArray
    braking: float


class Nominal(NamedTuple):
    """The original vehicle on a dry road. An ADS knows nothing else of the vehicle.

    `mass` [kg], `accel`, `decel` [m/s^2] and `max_speed` [m/s] are values of the vehicle's SUMO
    type. `actuator_lag` [s] is the time constant with which the wheels follow the pedals. The first
    call of `tables` drives the vehicle; `tables` returns `speeds`, `full_throttle`, `coasting` and
    `braking`. `length` and `width` [m] are those of the vehicle's body in the scenario; 0 outside
    of a run.
    """

    mass: float
    accel: float
    decel: float
    max_speed: float
    actuator_lag: float
    tables: Callable[[], PedalTables]
    length: float = 0.0
    width: float = 0.0

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
