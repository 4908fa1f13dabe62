"""The reference drivers against SUMO's own models, their formulas worked out by hand, and the
numbers of the regulations.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest

from safevar_sumo.ads.car_following import Acc, Idm
from safevar_sumo.ads.competent_driver import CompetentDriver
from safevar_sumo.ads.reference_drivers import (
    R157,
    FullBraking,
    FuzzySafety,
    Rss,
    falling_ramp,
)
from safevar_sumo.records import FloatArray, Nominal, PedalTables
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.network import CopiedNetwork
from tests.support.ideal import point_mass
from tests.support.in_process import SLOW
from tests.support.made_up import original_of, seen, system_of

STEP = 0.05
TABLE = np.arange(0.0, 20.5, 0.5)
KNOWN = Nominal(
    mass=1500.0,
    accel=3.0,
    decel=10.0,
    max_speed=50.0,
    actuator_lag=0.1,
    tables=lambda: PedalTables(
        speeds=TABLE,
        full_throttle=np.full(len(TABLE), 3.0),
        coasting=np.zeros(len(TABLE)),
        braking=10.0,
    ),
)
"""A vehicle whose brake pedal is the deceleration over 10 m/s^2."""
GAPS, SPEEDS, LEADERS = (
    values.ravel()
    for values in np.meshgrid(
        [1.0, 4.0, 12.0, 30.0, 80.0, 150.0], [2.0, 8.0, 13.0], [0.0, 5.0, 12.5]
    )
)


@pytest.fixture(scope="module")
def sumo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """libsumo with a vehicle of every model, all with SUMO's default parameters of a passenger car,
    cruising at 13.89 m/s.
    """
    folder = NETWORKS / "along"
    traffic = tmp_path_factory.mktemp("models") / "traffic.rou.xml"
    kinds = [
        f'<vType id="{name}" carFollowModel="{name}" minGap="2.5" tau="1" accel="2.6" decel="4.5"'
        f' maxSpeed="13.89" speedDev="0" sigma="0"/><vehicle id="{name}" type="{name}" route="r"'
        f' depart="0" departPos="{100 + 300 * i}"/>'
        for i, name in enumerate(("IDM", "ACC", "Krauss"))
    ]
    traffic.write_text(
        '<routes><route id="r" edges="road"/>' + "".join(kinds) + "</routes>"
    )
    with open_world(
        CopiedNetwork(folder / "network.net.xml", traffic, folder / "scenario.sumocfg"),
        0,
    ):
        import libsumo

        libsumo.simulationStep()
        yield libsumo


def sumo_accelerations(sumo: Any, model: str) -> np.ndarray:
    """Acceleration by SUMO's model in every state [m/s^2]."""
    speeds = [
        sumo.vehicle.getFollowSpeed(model, v, gap - 2.5, u, 4.5)
        for gap, v, u in zip(GAPS, SPEEDS, LEADERS, strict=True)
    ]
    return (np.array(speeds) - SPEEDS) / STEP


def test_idm_is_sumos(sumo: Any) -> None:
    expected = sumo_accelerations(sumo, "IDM")
    accelerations = Idm().acceleration_at(GAPS, SPEEDS, LEADERS)
    stops = SPEEDS + accelerations * STEP <= 0  # nobody drives backwards
    assert accelerations[~stops] == pytest.approx(expected[~stops], abs=1e-6)
    assert expected[stops] == pytest.approx(-SPEEDS[stops] / STEP, abs=1e-6)
    assert np.count_nonzero(~stops) > 30


def test_acc_is_sumos(sumo: Any) -> None:
    """At most as it approaches its cruise speed, which a vehicle of SUMO does not exceed either."""
    holding = 0.4 * (Acc().cruise_speed - SPEEDS)
    expected = np.minimum(sumo_accelerations(sumo, "ACC"), holding)
    accelerations = Acc().acceleration_at(GAPS, SPEEDS, LEADERS)
    compared = (SPEEDS + accelerations * STEP > 0) & (
        np.abs(expected - accelerations) < 1e-6
    )
    braked = (
        expected < accelerations - 1e-6
    )  # in danger, SUMO's emergency override brakes harder than the control law
    assert np.all(compared | braked | (SPEEDS + accelerations * STEP <= 0))
    assert np.count_nonzero(compared) > 35


@pytest.mark.parametrize("gap", [5.0, 30.0, 90.0, 120.0, 1000.0])
def test_acc_never_exceeds_its_cruise_speed(gap: float) -> None:
    """Behind a leader that is faster, too, for which the vehicle would otherwise accelerate."""
    acc = Acc(cruise_speed=10.0)
    speed = np.zeros(1)
    for _ in range(1000):
        acceleration = acc.acceleration_at(np.full(1, gap), speed, np.full(1, 30.0))
        speed = np.maximum(speed + STEP * acceleration, 0.0)
        assert speed[0] <= 10.0 + 1e-9
    if gap > 30:
        assert speed[0] == pytest.approx(10.0)


def braking(
    driver: Any,
    speed: float,
    gap: float,
    lateral: float = 0.0,
    lateral_speed: float = 0.0,
) -> tuple[float, np.ndarray]:
    """Gap at which a driver first brakes, at constant speed towards an obstacle, and the
    decelerations from then on.
    """
    memory = driver.start(1, KNOWN, STEP)
    first = np.nan
    decelerations = []
    for k in range(400):
        now = gap - speed * k * STEP
        if now <= 0:
            break
        one = seen(
            k * STEP,
            speed,
            now,
            lateral + lateral_speed * k * STEP,
            lateral_speed=lateral_speed,
        )
        command, memory = driver.drive(one, memory)
        if command.brake[0] > 0.05 and np.isnan(
            first
        ):  # more than the accelerator let go
            first = now
        if not np.isnan(first):
            decelerations.append(float(command.brake[0]) * 10)
    return first, np.array(decelerations)


@pytest.mark.parametrize("driver", [CompetentDriver(), Rss(), FuzzySafety(), R157()])
def test_who_reacts_releases_the_accelerator_and_brakes_by_what_is_missing(
    driver: Any,
) -> None:
    """The vehicle coasts with 1 m/s^2; the tables are those of a gear in which the original coasts
    with 3 m/s^2.
    """
    first_gear = KNOWN.tables()._replace(coasting=np.full(len(TABLE), 3.0))
    memory = driver.start(1, KNOWN._replace(tables=lambda: first_gear), STEP)
    speed = 12.0
    gap = 40.0
    commands = []
    for k in range(80):
        command, memory = driver.drive(
            seen(k * STEP, speed, gap, throttle=0.25), memory
        )
        commands.append((float(command.throttle[0]), float(command.brake[0])))
        gap = gap - speed * STEP
        speed = max(
            speed - (0.0 if commands[-1][0] else 1 + 10 * commands[-1][1]) * STEP, 0.0
        )
        if not speed or gap <= 0:
            break
    throttle, brake = np.array(commands).T
    released = np.argmax(throttle == 0)
    braking = np.argmax(brake > 0)
    assert released > 0
    assert (braking - released) * STEP == pytest.approx(
        driver.reaction_time, abs=2 * STEP
    )
    assert not throttle[released:].any()
    greatest = {"R157": 6.0, "FuzzySafety": 1 + 10 * brake.max()}.get(
        type(driver).__name__, 0.774 * 9.81
    )
    assert 1 + 10 * brake.max() == pytest.approx(greatest, abs=1e-6), (
        "of the vehicle, not of its brakes"
    )


def test_the_competent_driver_perceives_a_pedestrian_after_a_stray_of_0375_m() -> None:
    """From 2 m aside at 1 m/s, seen at once: it strays at 0.375 s, is perceived at 0.775 s with a
    TTC below 2 s, brakes 0.75 s later.
    """
    onset_gap, _ = braking(
        CompetentDriver(), 10.0, 20.0, lateral=-2.0, lateral_speed=1.0
    )
    assert onset_gap == pytest.approx(
        20.0 - 10 * (0.375 + 0.4 + 0.75), abs=10 * 2.1 * STEP
    )


@pytest.mark.parametrize("is_another", [False, True])
def test_another_body_ahead_that_is_slower_is_no_braking_leader(
    is_another: bool,
) -> None:
    """A leader at 15 m/s leaves; the next car, 30 m farther, drives 10 m/s."""
    driver = CompetentDriver()
    memory = driver.start(1, KNOWN, STEP)
    pedals = []
    for k in range(100):
        gap, leader = (20.0, 15.0) if k < 40 else (50.0 - 5 * (k - 40) * STEP, 10.0)
        one = seen(k * STEP, 15.0, gap, leader=leader)._replace(
            obstacle=np.array([float(is_another and k >= 40)])
        )
        command, memory = driver.drive(one, memory)
        pedals.append(command.brake[0])
    assert (max(pedals) > 0.05) == (not is_another), (
        "the same body would have braked by 100 m/s^2"
    )


def test_the_safe_distance_of_rss_allows_for_what_is_gained_while_reacting() -> None:
    """rt = 1 s at 2 m/s^2: from 20 to 22 m/s within 21 m; then 22^2 / 8 m to a stop, less the
    leader's 10^2 / 16 m.
    """
    driver = Rss(
        reaction_time=1.0, acceleration=2.0, deceleration=4.0, leader_deceleration=8.0
    )
    assert driver.safe_distance(np.array([20.0]), np.array([10.0]))[0] == pytest.approx(
        21 + 60.5 - 6.25
    )


def test_fuzzy_metrics_are_those_worked_out_by_hand() -> None:
    """v = 20, u = 10: d_safe = 15 + 50 - 50/7 + 2 = 59.857, d_unsafe = 15 + 33.333 - 7.143 =
    41.190, at gap - 2.
    """
    model = FuzzySafety()
    one = np.ones(1)
    for gap, pfs in ((62.0, 0.0), (43.1, 1.0), (52.523809, 0.5)):
        unsafe, safe = model.proactive_distances(20 * one, 10 * one)
        metric = falling_ramp(gap * one - model.margin, unsafe, safe)
        assert metric[0] == pytest.approx(pfs, abs=1e-3)
    # a = 0: v' = 20; closing = 7.5, d_safe = 7.5 + 12.5 = 20, d_unsafe = 7.5 + 8.333 = 15.833
    for gap, cfs in ((20.1, 0.0), (15.8, 1.0), (17.91667, 0.5)):
        assert model.critical_metric(gap * one, 20 * one, 10 * one, 0 * one)[
            0
        ] == pytest.approx(cfs, abs=1e-4)
    # a = -8, at most -4: v' = 12 - 3 = 9 < u = 10: a crash is ahead where the gap is below (12 -
    # 10)^2 / (2 * 4) = 0.5
    assert model.critical_metric(0.4 * one, 12 * one, 10 * one, -8 * one)[0] == 1
    assert model.critical_metric(0.6 * one, 12 * one, 10 * one, -8 * one)[0] == 0
    assert model.critical_metric(1.0 * one, 10 * one, 10 * one, 0 * one)[0] == 0


def by_the_rule(
    speed: float,
    headway: float,
    leader_braking: float,
    lets_go: float = 0.4,
    delay: float = 0.0,
    last: float = 0.0,
) -> float:
    """UN R157's driver behind a leader that brakes down to the speed `last`: least gap [m], or
    minus the closing speed of the collision [m/s].

    A point mass from `speed` [m/s] at a headway [s]: speed held for 0.4 s, accelerator let go for
    0.75 s, then the deceleration rises up to 0.774 g; each of them `delay` later.
    """
    mass = point_mass(
        np.array([speed]),
        speed * headway,
        lambda time: max(speed - leader_braking * time, last),
        lambda time, *_: (time >= 0.4 + delay, 0.774 * 9.81),
        released=lets_go,
    )
    return float(np.where(mass.hits, -mass.speed, mass.least)[0])


def follow(
    driver: Any, leader: FloatArray, headway: float, leaves: float = np.inf
) -> tuple[FloatArray, FloatArray, float]:
    """A driver in a vehicle without delays behind a leader with these speeds [m/s], from the same
    speed; the leader is out of the lane after a time [s]: his gaps [m] and speeds up to a
    collision, and the closing speed at the end.
    """
    memory = driver.start(1, KNOWN, STEP)
    v = leader[0]
    gap = leader[0] * headway
    gaps = [gap]
    speeds = [v]
    for k, (u, next_u) in enumerate(pairwise(leader)):
        command, memory = driver.drive(
            seen(k * STEP, v, gap, 4.0 * (k * STEP >= leaves), leader=u), memory
        )
        next_v = max(
            v + (3 * float(command.throttle[0]) - 10 * float(command.brake[0])) * STEP,
            0.0,
        )
        gap += (u + next_u - v - next_v) / 2 * STEP
        v = next_v
        gaps.append(gap)
        speeds.append(v)
        if gap < 0:
            break
    return np.array(gaps), np.array(speeds), v - next_u


def behind_a_braking_leader(
    driver: Any, speed: float, headway: float, leader_braking: float = 7.0
) -> float:
    """As `by_the_rule`, with a driver in a vehicle without delays, and a leader that brakes after a
    second.
    """
    leader = np.maximum(
        speed - leader_braking * np.maximum(np.arange(500) * STEP - 1, 0.0), 0.0
    )
    gaps, _, closing = follow(driver, leader, headway)
    return float(gaps.min() if gaps[-1] >= 0 else -closing)


@pytest.mark.parametrize(
    "headway", [1.0, *(pytest.param(v, marks=SLOW) for v in (1.4, 2.0))]
)
@pytest.mark.parametrize(
    "speed", [50.0, *(pytest.param(v, marks=SLOW) for v in (30.0, 80.0, 100.0, 130.0))]
)
def test_the_competent_driver_behind_a_braking_leader_does_what_the_rule_says(
    speed: float, headway: float
) -> None:
    """He holds the speed and the gap with which he began until he perceives the braking; half a
    step is 0.35 m/s.
    """
    for leader_braking in (5.2, 5.5, 6.0, 7.0, 8.0, 9.0):
        for lets_go in (0.0, 0.4):
            found = behind_a_braking_leader(
                CompetentDriver(lets_go=lets_go), speed / 3.6, headway, leader_braking
            )
            rule = by_the_rule(speed / 3.6, headway, leader_braking, lets_go)
            if (
                min(abs(found), abs(rule)) > 0.5
            ):  # nearer to contact, a metre is compared with a speed
                assert found == pytest.approx(rule, abs=0.4), f"{leader_braking} m/s^2"


def test_the_rule_has_the_numbers_of_the_regulation() -> None:
    """A leader with 7 m/s^2; the speed is held while the driver reacts, or the accelerator let
    go.
    """
    speeds = [kmh / 3.6 for kmh in (50, 80, 100)]
    assert [by_the_rule(speed, 2.0, 7.0, 0.0) for speed in speeds] == pytest.approx(
        [8.8, 15.1, 19.7], abs=0.05
    )
    assert [by_the_rule(speed, 2.0, 7.0) for speed in speeds] == pytest.approx(
        [10.0, 16.8, 21.8], abs=0.05
    )
    assert by_the_rule(speeds[0], 1.0, 7.0, 0.0) == pytest.approx(-8.8, abs=0.05)


@SLOW
def test_in_a_car_the_competent_driver_is_the_rule_and_the_cars_delays() -> None:
    """A worn car on a dry road, whose sensors are 0.05 s and whose brakes 0.1 s late; the leader
    brakes to 2 km/h.
    """
    over = {
        "speed": [50.0, 80.0, 100.0],
        "headway": [1.0, 2.0],
        "target_deceleration": [5.5, 7.0, 9.0],
    }
    car = {"vut_length": 4.7, "vut_width": 1.85}
    system = system_of(
        "wear",
        weather="clear",
        scenario={"model": "car_to_car", "parameters": {"test": "CCRb", **car}},
        matrix={
            "tests": [{"name": "CCRb", "parameters": {"test": "CCRb"}, "over": over}]
        },
        ads={"model": "competent_driver", "parameters": {}},
    )
    for point, (kmh, *rest) in zip(system.points, product(*over.values()), strict=True):
        trace = drive_worst(system.at(point), original_of(system)).trace
        gaps = trace.gap[trace.active]
        closing = (trace.speed - trace.obstacle_speed)[trace.active]
        found = gaps.min() if gaps.min() > 0 else -closing[-1]
        assert found == pytest.approx(
            by_the_rule(kmh / 3.6, *rest, delay=0.15, last=2 / 3.6), abs=0.3
        ), point.name


@pytest.mark.parametrize(
    "driver",
    [CompetentDriver(leader_braking=0.5), FullBraking(), FuzzySafety(), R157(), Rss()],
    ids=repr,
)
def test_nobody_accelerates_until_the_cause_of_a_danger_has_left_the_way(
    driver: Any,
) -> None:
    """The leader brakes from 22 to 10 m/s, drives on for 4 s, brakes to 6 m/s, drives on, and
    leaves the lane.
    """
    accelerations = np.repeat(
        [0.0, -4.0, 0.0, -4.0, 0.0], np.array([1, 3, 4, 1, 8]) * 20
    )
    gaps, speeds, _ = follow(
        driver, 22 + np.cumsum(accelerations) * STEP, 1.9, leaves=13.0
    )
    slows = int(np.argmax(speeds < 21.5))
    assert gaps[:260].min() > 0
    assert np.diff(speeds[slows:260]).max() < 1e-9
    assert speeds[-1] > speeds[260] + 5


def test_a_leader_who_drives_on_after_gentle_braking_is_a_danger_at_a_ttc_of_two_seconds() -> (
    None
):
    """From 80 to 60 km/h at 2 m/s^2, then steady: closing at 20 km/h, he reacts at 11.1 m."""
    leader = np.maximum(
        80 / 3.6 - 2.0 * np.maximum(np.arange(600) * STEP - 1, 0.0), 60 / 3.6
    )
    gaps, speeds, _ = follow(CompetentDriver(), leader, 2.0)
    released = int(np.argmax(speeds < 80 / 3.6 - 0.01))
    assert gaps[released] == pytest.approx(2 * 20 / 3.6, abs=3 * 20 / 3.6 * STEP)
    assert gaps.min() > 0


@pytest.mark.parametrize("leader_braking", [1.0, 4.0, 9.81])
def test_r157_avoids_a_braking_leader_from_its_least_time_gap_and_nearer_nothing_is_demanded(
    leader_braking: float,
) -> None:
    for speed in (20.0, 50.0, 60.0):
        least = 1 + speed / 100
        assert behind_a_braking_leader(R157(), speed / 3.6, least, leader_braking) > 0
        assert (
            behind_a_braking_leader(R157(), speed / 3.6, least - 0.001, leader_braking)
            < 0
        )


def test_rss_brakes_with_another_number_than_it_plans_with() -> None:
    onset_gap, decelerations = braking(Rss(deceleration=4.0, braking=6.0), 12.0, 60.0)
    assert onset_gap == pytest.approx(12**2 / (2 * 4), abs=2.1 * 12 * STEP), (
        "rt later than 12 * rt + 12^2 / (2 * 4)"
    )
    assert decelerations.max() == pytest.approx(6.0)


@pytest.mark.parametrize("share", [0.1, 0.35, 0.6, 0.85])
def test_drivers_see_a_danger_within_a_time_step(share: float) -> None:
    """What they have braked off at contact is that of the moment of the danger, wherever in a step
    it is.
    """
    speed = 12.0
    gap = 60.0 + share * speed * STEP
    end = np.ceil(gap / speed / STEP) * STEP
    _, of_r157 = braking(R157(), speed, gap)
    braked = end - (gap / speed - (speed / 12 + 0.45) + 0.35)
    assert of_r157.sum() * STEP == pytest.approx(6.0 * braked, abs=0.03)
    _, of_rss = braking(Rss(), speed, gap)
    hardest = 0.774 * 9.81
    braked = end - (gap - (speed * 0.75 + speed**2 / (2 * hardest))) / speed - 0.75
    assert of_rss.sum() * STEP == pytest.approx(
        hardest * (braked - hardest / 12.65 / 2), abs=0.03
    )
