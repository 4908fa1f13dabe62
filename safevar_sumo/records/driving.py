"""Quantities, and what a vehicle sees and does."""

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
"""A number, or an array of numbers that broadcasts to those of N vehicles or of T samples of N
encounters.
"""
NamedValues = dict[str, float]
"""Values by name, such as those of characteristics."""
JsonObject = dict[str, Any]
"""An object of JSON, or a table of TOML: plain values by key."""

STANDSTILL = 1e-3
"""Speed below which a vehicle counts as standing [m/s] (method section 4)."""
KMH_PER_MS = 3.6
"""km/h per m/s."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
TIME_ROUNDING = 1e-9
"""Difference below which two sums of time steps count as the same time [s]."""
TOUCH_OVERLAP = 2e-3
"""Overlap up to which bodies count as touching, not colliding: SUMO ignores an overlap of a
millimetre [m].
"""
LEAST_CLOSING_SPEED = 1e-3
"""Least closing speed that a collision counts with [m/s]: also one with a faster body is worse than
any distance.
"""
LENGTH_DECIMALS = 9
"""Decimals to which differences of distances are rounded: 4.7 m, not 4.699999999999996 m."""
TIME_DECIMALS = 9
"""Decimals to which sums of time steps are rounded: 0.15 s, not 0.15000000000000002 s."""
ZERO: FloatArray = np.zeros(())
"""Scalar zero, broadcast to all N vehicles."""
ALL_TRUE: BoolArray = np.ones((), bool)
"""Scalar True, broadcast to all N vehicles."""
UNDEFINED: FloatArray = np.array(np.nan)
"""Scalar NaN, broadcast to all N vehicles."""
for _constant in (ZERO, ALL_TRUE, UNDEFINED):
    _constant.flags.writeable = False


def nans(shape: int | tuple[int, ...]) -> FloatArray:
    """An array of undefined values."""
    return np.full(shape, np.nan)


def finite_or_none(value: float) -> float | None:
    """Make a number fit for JSON, which has neither NaN nor infinities: such a number becomes
    None.
    """
    if not np.isfinite(value):
        return None
    return float(value)


class Observation(NamedTuple):
    """Sensor values of N vehicles; every array has shape (N,).

    `gap` is the distance along the vehicle's path from its front bumper to the obstacle, infinite
    while the obstacle is not detected [m]; `lateral` is the obstacle's offset from the middle of
    the vehicle's lane, negative on the side that the obstacle comes from, infinite while it is out
    of sight [m]. `closing_speed` is the rate at which the gap shrinks, `obstacle_speed` the
    obstacle's own speed along the vehicle's path [m/s], `obstacle_width` its extent across the lane
    [m], `obstacle_length` its extent along the lane [m], both 0 where the scenario does not state
    them; `obstacle` is the number of the body that it is, of several; `throttle` and `brake` are
    the pedals' positions [-].
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
    """Pedals that the ADS of N vehicles commands, each in [0, 1], shape (N,)."""

    throttle: FloatArray
    brake: FloatArray


class PedalTables(NamedTuple):
    """The effect of the original vehicle's pedals on a dry road, at `speeds` [m/s].

    `full_throttle` is the acceleration at full throttle, `coasting` the deceleration without pedals
    [m/s^2]; `braking` is the deceleration that the brake adds per unit of pedal, far from the limit
    of the tyres [m/s^2].
    """

    speeds: FloatArray
    full_throttle: FloatArray
    coasting: FloatArray
    braking: float


class Nominal(NamedTuple):
    """The original vehicle on a dry road: all that an ADS knows of the vehicle.

    `mass` [kg], `accel`, `decel` [m/s^2] and `max_speed` [m/s] are values of its SUMO type;
    `actuator_lag` [s] is the time constant with which its wheels follow the pedals. `tables` drives
    the vehicle on its first call, and returns `speeds`, `full_throttle`, `coasting` and `braking`.
    `length` and `width` [m] are those of its body in the scenario; 0 outside a run.
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
