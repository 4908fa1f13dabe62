"""Friction of tyres on a wet road, from speed, depth of the water and depth of the tread.

mu = mu_0 / sqrt(1 + (k v^2)^2), k = a sqrt(w) / (b + t / (1 + (w / t_0)^2)), for the speed v [m/s],
the water w and the tread t [mm]. Water lifts a tyre by a pressure that grows with v^2, the texture
b of the road and the tread drain it, and deep water floods the grooves of a new tyre, t_0 = 8 mm.
The form is an assumption; a, b and the grip mu_0 on the dry road are fitted to published stops and
a handbook's table by `calibration/wet_friction.py` of the repository.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import FloatArray, FloatOrArray
from safevar_sumo.shipped import shipped_table

NEW_TREAD = 8.0
"""Tread of a new tyre [mm]."""
WET_FRICTION = shipped_table("vehicles/wet_friction.toml")
"""The fit: `worn` has the constants; `grip`, `water` and `handbook` what was fitted for each
source.
"""


def lift_of(
    water: FloatOrArray, tread: FloatArray, lift: float, texture: float
) -> FloatArray:
    """k [s^2/m^2], shape (N,), of treads at depths of water [mm]; 0 on a dry road."""
    flood = water / NEW_TREAD
    return lift * np.sqrt(water) / (texture + tread / (1 + flood * flood))


def lifted_friction(
    grip: FloatOrArray, lift: FloatArray, speed: FloatArray
) -> FloatArray:
    """mu at speeds [m/s], shape (N,); `grip` on a dry road or at rest."""
    lifted = lift * (speed * speed)
    return grip / np.sqrt(1 + lifted * lifted)
