"""Units of quantities: by factor and offset to SI base units, as a model description defines them, or by their common
names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

Values = TypeVar("Values", float, npt.NDArray[np.float64])
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""FMI's base units (FMI 2.0.4, section 2.2.2)."""


class Unit(NamedTuple):
    """A unit: value in SI = `factor` * value + `offset`; `exponents` belong to the units `BASE_UNITS`."""

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0

    def fits(self, other: Unit) -> bool:
        """Whether both measure the same kind of quantity; radians count as plain numbers."""
        return self.exponents[:-1] == other.exponents[:-1]

    def to(self, other: Unit, value: Values) -> Values:
        """A value or an array converted to another unit of the same kind; unchanged where both units are equal."""
        if (self.factor, self.offset) == (other.factor, other.offset):
            return value
        return (self.factor * value + (self.offset - other.offset)) / other.factor


def _unit(factor: float = 1.0, offset: float = 0.0, **exponents: int) -> Unit:
    return Unit(tuple(exponents.get(base, 0) for base in BASE_UNITS), factor, offset)


SI: Mapping[str, Unit] = {
    "-": _unit(),
    "s": _unit(s=1),
    "m": _unit(m=1),
    "m/s": _unit(m=1, s=-1),
    "m/s^2": _unit(m=1, s=-2),
    "kg": _unit(kg=1),
}
"""Units of the quantities that vehicles and driving systems exchange."""
_FORCE, _TORQUE = {"kg": 1, "m": 1, "s": -2}, {"kg": 1, "m": 2, "s": -2}
_POWER, _PRESSURE = {"kg": 1, "m": 2, "s": -3}, {"kg": 1, "m": -1, "s": -2}
COMMON_UNITS: Mapping[str, Unit] = {
    **SI,
    "": _unit(),
    "1": _unit(),
    "%": _unit(0.01),
    "rad": _unit(rad=1),
    "deg": _unit(math.pi / 180, rad=1),
    "ms": _unit(1e-3, s=1),
    "min": _unit(60.0, s=1),
    "h": _unit(3600.0, s=1),
    "1/s": _unit(s=-1),
    "Hz": _unit(s=-1),
    "mm": _unit(1e-3, m=1),
    "cm": _unit(1e-2, m=1),
    "km": _unit(1e3, m=1),
    "m2": _unit(m=2),
    "m^2": _unit(m=2),
    "m.s-1": _unit(m=1, s=-1),
    "km/h": _unit(1 / 3.6, m=1, s=-1),
    "kph": _unit(1 / 3.6, m=1, s=-1),
    "mph": _unit(0.44704, m=1, s=-1),
    "m/s2": _unit(m=1, s=-2),
    "m/s**2": _unit(m=1, s=-2),
    "m.s-2": _unit(m=1, s=-2),
    "g": _unit(1e-3, kg=1),
    "t": _unit(1e3, kg=1),
    "rad/s": _unit(rad=1, s=-1),
    "rpm": _unit(math.pi / 30, rad=1, s=-1),
    "r/min": _unit(math.pi / 30, rad=1, s=-1),
    "N": _unit(**_FORCE),
    "kN": _unit(1e3, **_FORCE),
    "N.m": _unit(**_TORQUE),
    "Nm": _unit(**_TORQUE),
    "J": _unit(**_TORQUE),
    "W": _unit(**_POWER),
    "kW": _unit(1e3, **_POWER),
    "Pa": _unit(**_PRESSURE),
    "kPa": _unit(1e3, **_PRESSURE),
    "bar": _unit(1e5, **_PRESSURE),
    "K": _unit(K=1),
    "degC": _unit(1.0, 273.15, K=1),
}
"""Units by their common names, for models whose description does not define them."""
