"""Commands and observations of driving systems."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import (
    Nominal,
    PedalTables,
)

COASTING, FULL, BRAKING = 0.1, 2.0, 10.0
SPEEDS = np.arange(0.0, 20.5, 0.5)
KNOWN = Nominal(
    mass=1500.0,
    accel=3.0,
    decel=8.0,
    max_speed=50.0,
    actuator_lag=0.2,
    tables=lambda: PedalTables(
        speeds=SPEEDS,
        full_throttle=np.full(len(SPEEDS), FULL),
        coasting=np.full(len(SPEEDS), COASTING),
        braking=BRAKING,
    ),
)
