"""The least time to collision and the deceleration rate along the path, from gaps and speeds
alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.scenarios.crossing import Crossing
from tests.support.ideal import met_at_once
from tests.support.made_up import system_of

WEAR = system_of("wear", matrix=None, weather="clear")


def measured(runs: SimulationRuns) -> FloatArray:
    """`ttc_min` [s] and `drac` [m/s^2] of N vehicles, shape (2, N)."""
    return np.stack(
        [OPTIONAL_METRICS[name].function(runs, None) for name in ("ttc_min", "drac")]
    )


def along_the_path(runs: SimulationRuns) -> FloatArray:
    """Both for somebody who crosses at right angles: gap / v and v^2 / (2 gap), as long as he is in
    the strip that the vehicle drives over or will be when it arrives.
    """
    trace = runs.trace
    with np.errstate(all="ignore"):
        ttc = trace.gap / trace.speed
        rate = trace.speed**2 / (2 * trace.gap)
        nearest = np.minimum(
            np.abs(trace.lateral), np.abs(trace.lateral + trace.lateral_speed * ttc)
        )
    meets = (
        (nearest < (trace.vehicle_width + trace.obstacle_width) / 2)
        & (trace.gap > 0)
        & (trace.speed > 1e-3)
    )
    counts = (
        meets
        & trace.active
        & runs.encounter.in_conflict
        & np.isnan(runs.collision_speed)
    )
    both = (
        np.where(counts, ttc, np.inf).min(axis=0),
        np.where(counts, rate, 0).max(axis=0),
    )
    return np.where(counts.any(axis=0), both, np.nan)


@pytest.mark.parametrize("test", ["CPNA", "CPFA", "CBNA"])
def test_towards_who_crosses_only_the_way_along_the_path_counts(test: Any) -> None:
    kmh, place, target = (
        np.random.default_rng(3).uniform((10, -20, 4), (60, 120, 25), (300, 3)).T
    )
    scenario = Crossing(
        test=test, speed=kmh, impact_location=place, target_speed=target
    )
    runs = met_at_once(WEAR, scenario, WEAR.ads, 300)
    expected = along_the_path(runs)
    assert np.isfinite(expected).sum() > 200
    assert measured(runs) == pytest.approx(expected, nan_ok=True)
