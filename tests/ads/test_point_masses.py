"""Reference drivers behind somebody who brakes or cuts in, beside point masses that obey the
published rules.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safevar_sumo.ads.reference_drivers import FuzzySafety, Rss
from safevar_sumo.api.simulation import load_study
from safevar_sumo.scenarios.ahead import CarToCar
from safevar_sumo.scenarios.lane_change import CAR, CutIn
from safevar_sumo.scenarios.tracks import VUT_WIDTH
from safevar_sumo.sumo.system import assemble
from tests.scenarios.ideal import Mass, agreement, ideal, met_at_once, point_mass

CAR_ON_DRY_ROAD = assemble(load_study("wear", weather="clear", matrix=None))
LANE, PATH, CORRIDOR = 3.5, (VUT_WIDTH + CAR.width) / 2, 1.15 + CAR.width / 2


def rss(v: Any, u: Any, gap: Any, acceleration: Any) -> Any:
    """Shalev-Shwartz et al.: v for 0.75 s, then both brake with 0.774 g; who is nearer than that
    brakes to a stop.
    """
    hardest = 0.774 * 9.81
    return gap < v * 0.75 + (v**2 - u**2) / (2 * hardest), hardest


def fuzzy(v: Any, u: Any, gap: Any, acceleration: Any) -> Any:
    """Mattas et al.: from 0 to 4 m/s^2 by PFS, from 4 to 6 by CFS; another test works both out by
    hand.
    """
    pfs = FuzzySafety().proactive_metric(gap, v, u)
    cfs = FuzzySafety().critical_metric(gap, v, u, acceleration)
    return pfs + cfs > 0, np.where(cfs > 0, 4 + 2 * cfs, 4 * pfs)


def mass(
    driver: Any, v: Any, gap: Any, u: Any, sideways: Any, brakes_at: Any, braking: Any
) -> Mass:
    """A driver who sees a car as soon as it is in his corridor, or will be when he reaches it."""

    def rule(time: float, v: Any, u: Any, gap: Any, acceleration: Any) -> Any:
        lateral = np.maximum(LANE - sideways * time, 0)
        arrives = np.where(v > u, gap / np.maximum(v - u, 0.1), 1e6)
        at_arrival = np.abs(lateral - np.sign(lateral) * sideways * arrives)
        is_dangerous, hardest = driver(v, u, gap, acceleration)
        return is_dangerous & (gap > 0) & (np.minimum(lateral, at_arrival) <= CORRIDOR), hardest

    return point_mass(
        v,
        gap,
        lambda time: np.maximum(u - braking * np.maximum(time - brakes_at, 0), 0),
        rule,
        (LANE - PATH) / sideways,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "rule"), [(Rss(), rss), (FuzzySafety(), fuzzy)], ids=["rss", "fuzzy_safety"]
)
def test_in_200_followings_and_200_cut_ins_drivers_end_as_point_masses_by_their_rules(
    driver: Any, rule: Any
) -> None:
    """In a car without drag or lag."""
    rng = np.random.default_rng(1)
    kmh, headway, braking = rng.uniform((20, 0.8, 1), (130, 3, 10), (200, 3)).T
    v = kmh / 3.6
    following = CarToCar(
        test="CCRb", speed=kmh, headway=headway, target_deceleration=braking, final_speed=0
    )
    behind = mass(rule, v, headway * v, v, 1e6, 3, braking)

    kmh, slower, gap, sideways, braking = rng.uniform(
        (40, 0, 10, 0.5, 0), (130, 60, 80, 3, 8), (200, 5)
    ).T
    target = np.maximum(kmh - slower, 10)
    gap = np.maximum(
        gap, (kmh - target) / 3.6 / sideways
    )  # else it is beside the vehicle before it is in the lane
    cut_in = CutIn(
        speed=kmh, target_speed=target, gap=gap, lateral_speed=sideways, target_deceleration=braking
    )
    beside = mass(rule, kmh / 3.6, gap, target / 3.6, sideways, LANE / sideways, braking)

    agreeing = 0
    for scenario, expected in ((following, behind), (cut_in, beside)):
        same, _ = agreement(
            met_at_once(ideal(CAR_ON_DRY_ROAD), scenario, driver, 200), expected, PATH
        )
        assert 0.1 < expected.hits.mean() < 0.9
        agreeing += same.sum()
    assert agreeing >= 396


def test_rss_does_not_drive_up_to_who_cuts_in_and_brakes() -> None:
    """The car brakes from 71.1 km/h to a stop: a point mass keeps 23.5 m. RSS plans without an
    acceleration.
    """
    expected = mass(rss, np.array([107.2 / 3.6]), 55.6, 71.1 / 3.6, 2.3, LANE / 2.3, 4)
    assert expected.least[0] == pytest.approx(23.5, abs=0.1)
    scenario = CutIn(
        speed=107.2, target_speed=71.1, gap=55.6, lateral_speed=2.3, target_deceleration=4
    )
    runs = met_at_once(CAR_ON_DRY_ROAD, scenario, Rss(), 1)
    assert runs.outcome[0] == "stopped"
    assert not runs.trace.throttle[int(np.argmax(runs.trace.brake > 0)) :].any()
