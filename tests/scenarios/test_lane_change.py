"""Cut-in, cut-out and following of UN R157: who moves how, and its driver by a second
implementation of the rule.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.ads.reaction import ANY_BRAKING
from safevar_sumo.scenarios.lane_change import OTHER_CAR, CutIn, CutOut
from safevar_sumo.sumo.matrix import drive_worst, simulate_all_points
from tests.support.holding import Hold, at_contact, driven
from tests.support.ideal import STEP, Mass, agreement, ideal, met_at_once, point_mass
from tests.support.in_process import SLOW, verify_everywhere, write
from tests.support.made_up import original_of, system_of

WEAR = system_of("wear", matrix=None)
IDEAL = ideal(WEAR)
LENGTH, WIDTH = 4.7, 1.85
BODY: dict[str, Any] = {"vut_length": LENGTH, "vut_width": WIDTH}
PATH = (WIDTH + OTHER_CAR.width) / 2
HARDEST = 0.774 * 9.81


def rule(v: Any, gap: Any, u: Any, beside: Any, perceived: Any) -> Mass:
    """The regulation's driver: perceived at a time, a danger at a TTC below 2 s; he releases the
    accelerator, and brakes with up to 0.774 g.
    """

    def near(time: float, v: Any, u: Any, gap: Any, _: Any) -> Any:
        return (time >= perceived) & (gap > 0) & (gap < 2.0 * (v - u)), HARDEST

    return point_mass(v, gap, lambda time: u, near, beside, released=0.4)


N = 1000
RANDOM = np.random.default_rng(7)


def draw(low: float, high: float) -> Any:
    return low + RANDOM.random(N) * (high - low)


def assert_near(same: Any, late: Any) -> None:
    """99 % are equal, and 98 % of their gaps or closing speeds are within 0.5 m or 0.5 m/s of the
    rule's.
    """
    assert same.mean() >= 0.99
    assert np.mean(np.abs(late) < 0.5) >= 0.98


@SLOW
def test_the_competent_driver_answers_cut_ins_by_the_rule() -> None:
    """Ahead and beside: he brakes for a car that he will be beside, too."""
    v = draw(40.0, 130.0)
    scenario = CutIn(
        speed=v,
        target_speed=np.maximum(v - draw(10.0, 60.0), 10.0),
        gap=draw(3.0, 60.0),
        lateral_speed=draw(0.5, 1.8),
        **BODY,
    )
    beside = (3.5 - PATH) / scenario.lateral_speed
    expected = rule(
        v / 3.6,
        scenario.gap,
        scenario.target_speed / 3.6,
        beside,
        0.375 / scenario.lateral_speed + 0.4,
    )
    same, late = agreement(
        met_at_once(IDEAL, scenario, CompetentDriver(), N), expected, PATH
    )
    is_ahead = scenario.gap - (v - scenario.target_speed) / 3.6 * beside > 0
    assert 0.1 < expected.hits.mean() < 0.9
    assert_near(same[is_ahead], late[is_ahead & same])
    assert same[~is_ahead].mean() >= 0.98


@SLOW
def test_the_competent_driver_answers_cut_outs_by_the_rule() -> None:
    """At the regulation's headway of 2 s."""
    v = draw(20.0, 130.0)
    lateral_speed = draw(0.5, 1.8)
    gap = v / 3.6 * OTHER_CAR.width / lateral_speed * draw(1.0, 2.0)
    scenario = CutOut(
        speed=v, headway=2.0, gap=gap, lateral_speed=lateral_speed, **BODY
    )
    perceived = np.maximum(
        0.375 / lateral_speed + 0.4, OTHER_CAR.width / 2 / lateral_speed
    )
    expected = rule(
        v / 3.6, 2.0 * v / 3.6 + OTHER_CAR.length + gap, 0.0, 0.0, perceived
    )
    same, late = agreement(
        met_at_once(IDEAL, scenario, CompetentDriver(), N), expected, PATH
    )
    assert 0.1 < expected.hits.mean() < 0.9
    assert_near(same, late[same])


def test_a_cut_in_moves_as_it_says() -> None:
    """Gap, place and speed when it begins, when it is in the lane and when it has stopped, from
    either side.
    """
    for side, sign in (("left", 1.0), ("right", -1.0)):
        one = CutIn(
            speed=90.0,
            target_speed=72.0,
            gap=30.0,
            lateral_speed=1.75,
            target_deceleration=5.0,
            side=side,
        )
        (car,) = one.tracks(np.array([[0.0], [1.0], [2.0], [3.0], [5.0], [7.0], [9.0]]))
        rear = car.x[:, 0] - OTHER_CAR.length / 2
        assert rear[1] - 25.0 == pytest.approx(30.0)
        assert (car.y[:, 0] * sign).tolist() == pytest.approx(
            [3.5, 3.5, 1.75, 0.0, 0.0, 0.0, 0.0]
        )
        assert car.speed[:, 0].tolist() == pytest.approx(
            [20.0, 20.0, 20.0, 20.0, 10.0, 0.0, 0.0]
        )
        assert rear[-1] - rear[1] == pytest.approx(2 * 20.0 + 20.0**2 / (2 * 5.0))


def test_a_cut_out_hides_the_standing_car_until_the_leader_is_aside() -> None:
    """The line of sight leads along the lane, so the leader hides it until he is half his width off
    his way.
    """
    one = CutOut(speed=72.0, headway=1.0, gap=60.0, lateral_speed=1.0, **BODY)
    run = driven(one, Hold(), system=WEAR)
    gap = run.trace.gap[:, 0]
    assert gap[20] == pytest.approx(20.0)
    shown = int(np.argmax(np.diff(gap) > 10)) + 1
    assert run.trace.time[shown] == pytest.approx(
        1.0 + OTHER_CAR.width / 2, abs=2 * STEP
    )
    assert gap[shown] == pytest.approx(
        20.0 + OTHER_CAR.length + 60.0 - 20.0 * (run.trace.time[shown] - 1.0)
    )
    assert at_contact(run, run.trace.time) == pytest.approx(
        1.0 + (20.0 + OTHER_CAR.length + 60.0) / 20.0
    )


def test_whose_collision_it_is() -> None:
    """At 80 against 60 km/h and 1 m/s the car is in the path after 1.63 s, when a gap of 9.03 m is
    closed: from then on the vehicle drives into its rear; before, the car drives its flank into the
    vehicle's side, and that is listed only.
    """
    border = (20.0 / 3.6) * (3.5 - PATH)
    for gap, side, outcome in (
        (border - 0.3, "left", "passed"),
        (border + 0.3, "front", "collision"),
    ):
        run = driven(
            CutIn(speed=80.0, target_speed=60.0, gap=gap, **BODY), Hold(), system=WEAR
        )
        assert (run.contact.side[0], run.outcome[0]) == (side, outcome)
    mirrored = driven(
        CutIn(speed=80.0, target_speed=60.0, gap=border - 0.3, side="right", **BODY),
        Hold(),
        system=WEAR,
    )
    assert mirrored.contact.side[0] == "right"


@SLOW
def test_the_original_avoids_all_encounters_and_the_regulations_driver_all_but_two() -> (
    None
):
    """He waits for a TTC of 2 s, which is too late before a standing car at 60 km/h."""
    too_fast = {"cut_out, speed 60, wet", "cut_out, speed 80, wet"}
    for ads, failures in (
        ({"model": "aeb"}, set()),
        (
            {
                "model": "competent_driver",
                "parameters": {"leader_braking": ANY_BRAKING},
            },
            too_fast,
        ),
    ):
        system = system_of("alks", ads=ads)
        results = simulate_all_points(system, original_of(system))
        degrees = {
            point.name: result.evaluations.f_safe[0]
            for point, result in zip(system.points, results, strict=True)
        }
        assert len(degrees) == 15
        assert {name for name, degree in degrees.items() if degree < 0} == failures
        assert all(
            degree >= 0.3 for name, degree in degrees.items() if name not in failures
        )


SCRIPT = """
def step(traci, vehicle_id):
    leader = traci.vehicle.getLeader(vehicle_id, 100)
    if leader and leader[1] < 30:
        traci.vehicle.slowDown(vehicle_id, 8, 1.0)
"""
FOLLOWING = {
    "test": "CCRb",
    "speed": 80.0,
    "headway": 2.0,
    "target_deceleration": 7.0,
    "final_speed": 0.0,
}
ENCOUNTERS = (
    ("cut_in", {"gap": 25.0}),
    ("cut_in", {"gap": 8.0, "side": "right"}),
    ("cut_out", {}),
    ("car_to_car", FOLLOWING),
)


@SLOW
@pytest.mark.parametrize("ads", ["aeb", "idm", "acc", "script:step"])
@pytest.mark.parametrize(("model", "parameters"), ENCOUNTERS)
def test_whoever_drives_the_actors_are_where_sumo_has_them(
    model: str, parameters: dict[str, Any], ads: str, in_tmp: Path
) -> None:
    """The test's speed is held until the driving system acts, be it an AEB, one that drives itself
    or a script.
    """
    write("script.py", SCRIPT)
    scenario = {"model": model, "parameters": BODY | parameters}
    driver = {"model": ads, "parameters": {}, "kind": "traci" if ":" in ads else ""}
    system = system_of("wear", matrix=None, scenario=scenario, ads=driver)
    vehicles = np.stack([system.characteristics.original, system.characteristics.lower])
    run = drive_worst(system, vehicles)
    verify_everywhere(system, vehicles)
    assert (run.trace.speed[0] == system.points[0].scenario.test_speed).all()
    assert (np.abs(run.test_speed_error) < 0.1).all()
    assert (np.abs(np.diff(run.trace.speed, axis=0)) > 0.01).any(axis=0).any()
