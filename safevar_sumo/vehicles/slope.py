"""What a road that rises or falls does to whoever drives on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray

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
