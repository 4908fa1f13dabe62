"""Friction coefficient mu of tyres on a wet road, from speed, depth of water and depth of tread.

mu = mu_0 / sqrt(1 + (k v^2)^2) with k = a sqrt(w) / (b + t / (1 + (w / t_0)^2)), for the speed v
[m/s], the depth w of water and the depth t of the tread [mm]. Water lifts a tyre by a pressure that
grows with v^2. The texture b of the road and the tread drain the water. Water floods the grooves of
a tyre if it is about as deep as the tread of a new tyre, t_0 = 8 mm. The form of these equations is
an assumption; a, b and the grip mu_0 on the dry road are fitted to published stops and a handbook's
table by `calibration/wet_friction.py` of the repository.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import FloatArray, FloatOrArray
from safevar_sumo.shipped import shipped_table

NEW_TREAD = 8.0
"""Tread of a new tyre [mm]."""
WET_FRICTION = shipped_table("vehicles/wet_friction.toml")
"""The fitted values: `worn` has the constants of `WornVehicle`; `grip`, `water` and `handbook` have
the values that were fitted for each source.
"""


def lift_of(
    water: FloatOrArray, tread: FloatArray, lift: float, texture: float
) -> FloatArray:
    """The coefficient k [s^2/m^2], shape (N,), of treads at depths of water [mm]; 0 on a dry road.

    `lift` is the constant a, `texture` the constant b.
    """
    flood = water / NEW_TREAD
    return lift * np.sqrt(water) / (texture + tread / (1 + flood * flood))


def lifted_friction(
    grip: FloatOrArray, lift: FloatArray, speed: FloatArray
) -> FloatArray:
    """The friction coefficient mu at speeds [m/s], shape (N,), from the friction coefficient `grip`
    at rest and the coefficient `lift` (k). On a dry road (`lift` is 0), mu is `grip`.
    """
    lifted = lift * (speed * speed)
    return grip / np.sqrt(1 + lifted * lifted)
