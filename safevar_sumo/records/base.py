"""Types of arrays, and the constants and scalars that all stages share."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int_]

STANDSTILL = 1e-3
"""Speed below which a vehicle counts as standing [m/s] (method section 4)."""
KMH_PER_MS = 3.6
"""km/h per m/s."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
TIME_ROUNDING = 1e-9
"""Difference below which two sums of time steps count as the same time [s]."""
TOUCH_OVERLAP = 2e-3
"""Overlap up to which bodies count as touching, not colliding: SUMO ignores an overlap of a millimetre [m]."""
TIME_DECIMALS = 9
"""Decimals to which sums of time steps are rounded: 0.15 s, not 0.15000000000000002 s."""
ZERO: FloatArray = np.zeros(())
"""Scalar zero, broadcast to all N vehicles."""
ALL_TRUE: BoolArray = np.ones((), dtype=bool)
"""Scalar True, broadcast to all N vehicles."""
UNDEFINED: FloatArray = np.array(np.nan)
"""Scalar NaN, broadcast to all N vehicles."""
for _constant in (ZERO, ALL_TRUE, UNDEFINED):
    _constant.flags.writeable = False


def finite_or_none(value: float) -> float | None:
    """Make a number fit for JSON, which has neither NaN nor infinities: such a number becomes None."""
    return float(value) if np.isfinite(value) else None
