"""Every ADS: vehicles are independent, pedals are in range, a scalar ADS has an instance per
vehicle; warnings. Commands of the shipped ADSs are those of their formulas.
"""

from __future__ import annotations

import copy
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from msgspec.structs import force_setattr

from safevar_sumo.ads import ADS, Ads, PerVehicleAds, ScalarAds
from safevar_sumo.ads.aeb import Aeb, AutowareAeb
from safevar_sumo.ads.car_following import Krauss
from safevar_sumo.ads.published import Apollo, WorldOnRails
from safevar_sumo.plugins import UserCode
from safevar_sumo.plugins.contract import checked_class
from safevar_sumo.records import (
    Command,
    FloatArray,
    Nominal,
    Observation,
    SimulationRuns,
)
from safevar_sumo.scenarios import Along, CarToCar
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.study import ModelTable, study_names
from safevar_sumo.sumo.system import assemble
from tests.support.holding import CARLA, Hold, driven
from tests.support.in_process import SLOW
from tests.support.made_up import MISSING, changed, seen, system_of
from tests.support.pedals import BRAKING, COASTING, FULL, KNOWN

STEP = 0.05
WORN = system_of("wear", matrix=None)
STUDIES = {study.ads.model: study for study in map(read_study, study_names())}
NATIVE = read_study("native")
UNAVAILABLE = {read_study(name).ads.model for name in MISSING}
SYSTEMS = {
    name: assemble(
        STUDIES.get(name, msgspec.structs.replace(NATIVE, ads=ModelTable(model=name)))
    )
    for name in ADS
    if name not in UNAVAILABLE
}
TAKE_OVER = [
    "ad_rss",
    "aeb",
    "autoware_aeb",
    "competent_driver",
    "full_braking",
    "fuzzy_safety",
    "highway_idm",
    "r157",
    "rss",
]
"""ADSs that keep the initial speed."""
FAR = 1e6


@pytest.fixture(params=sorted(SYSTEMS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def approach(
    ads: Ads, nominal: Nominal, speed: FloatArray, gap: FloatArray
) -> FloatArray:
    """Pedals over time, shape (T, 2, N), of vehicles whose speed stays constant whatever the pedals
    are.
    """
    memory = ads.start(len(speed), nominal, STEP)
    pedals = []
    for step in range(80):
        command, memory = ads.drive(
            seen(step * STEP, speed, gap - speed * step * STEP, lateral_speed=1.8),
            memory,
        )
        pedals.append(np.stack(command))
    return np.stack(pedals)


@SLOW
@settings(max_examples=8)
@given(
    speed=arrays(float, 6, elements=st.floats(0, 15, allow_subnormal=False)),
    gap=arrays(float, 6, elements=st.floats(0.5, 80)),
)
def test_pedals_stay_in_range_and_no_vehicle_knows_of_another(
    speed: FloatArray, gap: FloatArray
) -> None:
    for system in SYSTEMS.values():
        nominal = system.nominal
        together = approach(system.ads, nominal, speed, gap)
        assert np.all((together >= 0) & (together <= 1))
        assert not np.any((together[:, 0] > 0) & (together[:, 1] > 0)), (
            "no vehicle accelerates and brakes at once"
        )
        assert (
            approach(system.ads, nominal, speed[2:3], gap[2:3])[..., 0].tobytes()
            == together[..., 2].tobytes()
        )


def test_a_standing_obstacle_close_ahead_makes_it_brake(name: str) -> None:
    system = SYSTEMS[name]
    pedals = approach(system.ads, system.nominal, np.array([5.0]), np.array([20.0]))
    assert pedals[:, 1, 0].max() > 0.1


def test_emergency_braking_brakes_at_a_walking_pace_if_the_gap_closes_soon() -> None:
    """At 0.8 m/s, a gap of 0.2 m closes in 0.25 s, and one of 40 m in 50 s."""
    speed, gap = np.array([0.8, 0.8]), np.array([0.2, 40.0])
    brake = approach(Aeb(), CARLA.nominal, speed, gap)[:, 1].max(axis=0)
    assert brake[0] > 0.1
    assert brake[1] == 0


def test_an_open_road_makes_it_drive(name: str) -> None:
    system = SYSTEMS[name]
    pedals = approach(system.ads, system.nominal, np.array([0.0]), np.array([1e3]))
    assert pedals[-1, 0, 0] > 0.1 or name in TAKE_OVER
    assert pedals[:, 1].max() == 0


class Timid(ScalarAds):
    """Brakes in front of everything, and counts its calls."""

    def __init__(self, distance: float = 10.0) -> None:
        self.distance = distance
        self.calls = 0

    def drive(self, seen: Observation) -> tuple[float, float]:
        self.calls += 1
        return (0.0, 1.0) if seen.gap < self.distance else (0.1 * self.calls, 0.0)


def test_a_scalar_ads_drives_every_vehicle_with_an_instance_of_its_own() -> None:
    ads = PerVehicleAds(Timid, UserCode("ads"))
    nominal = SYSTEMS["krauss"].nominal
    memory = ads.start(3, nominal, STEP)
    gap = np.array([5.0, 50.0, 50.0])
    for expected in ([0.0, 0.1, 0.1], [0.0, 0.2, 0.2]):
        command, memory = ads.drive(seen(0.0, 0.0, gap), memory)
        assert command.throttle.tolist() == pytest.approx(expected)
        assert command.brake.tolist() == [1.0, 0.0, 0.0]
    assert memory[0].nominal.mass == nominal.mass
    assert not nominal.tables().speeds.flags.writeable
    assert memory[0].step == STEP


def worn(scenario: Any, latency: float, ads: Any) -> SimulationRuns:
    return driven(scenario, ads, changed(WORN, sensorLatency=latency), WORN)


@pytest.mark.parametrize("latency", [0.05, 0.25, 0.4])
@pytest.mark.parametrize(
    "scenario",
    [
        CarToCar(test="CCRs", speed=60),
        Along(test="CPLA", speed=60),
        Along(test="CBLA", speed=70),
    ],
)
def test_sensors_that_are_late_warn_as_much_later(
    scenario: Any, latency: float
) -> None:
    """The first step in which the observed gap / closing speed is below 2.2 s: a true TTC of 2.2 s
    - latency, or one step less.
    """
    warned = worn(scenario, latency, Aeb(warning_time=2.2)).warning_ttc[0]
    assert 2.2 - latency - STEP <= warned + 1e-9
    assert warned < 2.2 - latency + 1e-9


class Near(ScalarAds):
    """Warns, and does no more, below a gap of 20 m."""

    def drive(self, seen: Any) -> tuple[float, float]:
        self.warns = seen.gap < 20
        return seen.throttle, seen.brake


class NearForMany(Hold):
    """The ADS `Near` over arrays of vehicles."""

    def drive(self, seen: Any, memory: Any) -> tuple[Command, Any]:
        self._near = seen.gap < 20
        return super().drive(seen, memory)

    def warns(self, memory: Any) -> Any:
        return self._near


@SLOW
def test_an_ads_of_ones_own_warns() -> None:
    original = CARLA.characteristics.original
    for_many = checked_class(UserCode("ads", NearForMany), Ads)()
    for ads in (PerVehicleAds(Near, UserCode("ads")), for_many):
        run = driven(
            CarToCar(test="CCRs", speed=36), ads, np.stack([original, original])
        )
        assert run.warning_ttc == pytest.approx([2.0, 2.0], abs=STEP + 1e-6)


world_on_rails = partial(
    WorldOnRails,
    first_command=0.0,
    latency=0.0,
    corridor=2.5,
    brake_gap=9.0,
    brake_gap_per_speed=0.0,
    brake_place=0.0,
    brake_gap_before=0.0,
    brake_gap_past=0.0,
    throttle=(0.9, 0.7, 0.4),
)
apollo = partial(
    Apollo,
    first_command=0.0,
    cruise_speed=8.0,
    cruise_gain=1.0,
    cruise_acceleration=1.5,
    jerk=5.0,
    stop_gap=5.0,
    comfortable_deceleration=2.0,
    largest_deceleration=3.0,
    creep_speed=0.5,
    creep_time=1.0,
    pedal_lag=0.1,
)


@pytest.mark.parametrize(
    ("speed", "throttle"),
    [
        (0.0, 0.9),
        (4 / 3, 0.8),
        (8 / 3, 0.7),
        (4.0, 0.55),
        (16 / 3, 0.4),
        (20 / 3.6 - 1e-6, 0.4),
        (20 / 3.6 + 1e-6, 0.0),
    ],
)
def test_world_on_rails_throttle_is_linear_between_its_speeds_and_none_above_20_kmh(
    speed: float, throttle: float
) -> None:
    ads = world_on_rails()
    command, _ = ads.drive(seen(1.0, speed, FAR), ads.start(1, KNOWN, STEP))
    assert command.throttle[0] == pytest.approx(throttle)


@pytest.mark.parametrize(
    ("gap", "speed", "brakes"),
    [(0.6, 1.0, 1), (0.5, 1.0, 0), (0.4, 0.0, 0), (-0.2, 1.0, 0)],
)
def test_world_on_rails_sees_nothing_nearer_than_its_gap_of_release(
    gap: float, speed: float, brakes: int
) -> None:
    """Though it braked before, and whether it moves or stands."""
    ads = world_on_rails(release_gap=0.5)
    memory = ads.start(1, KNOWN, STEP)._replace(is_braking=np.ones(1, dtype=bool))
    command, _ = ads.drive(seen(1.0, speed, gap), memory)
    assert (command.brake[0], command.throttle[0] > 0) == (brakes, not brakes)


@given(lateral=st.floats(-3, 3), speed=st.floats(0, 8), gap=st.floats(0, 12))
def test_world_on_rails_brakes_up_to_a_gap_that_shrinks_before_and_past_its_place(
    lateral: float, speed: float, gap: float
) -> None:
    ads = world_on_rails(
        brake_gap_per_speed=-0.5,
        brake_place=-0.4,
        brake_gap_before=10.0,
        brake_gap_past=2.0,
    )
    short = max(-0.4 - lateral, 0.0)
    limit = 0.9 * (9.0 - 0.5 * speed - 10.0 * short - 2.0 * max(lateral + 0.4, 0.0))
    assume(abs(gap - limit) > 1e-9)
    now = seen(1.0, speed, gap, lateral, 0.9)
    command, memory = ads.drive(now, ads.start(1, KNOWN, STEP))
    assert bool(command.brake[0]) == (gap < limit and abs(lateral) <= 2.5)
    # Once it brakes, it goes on until the obstacle has left its corridor.
    farther_command, _ = ads.drive(now._replace(gap=np.full(1, 50.0)), memory)
    assert farther_command.brake[0] == command.brake[0]
    free_command, _ = ads.drive(now._replace(lateral=np.full(1, 2.6)), memory)
    assert free_command.brake[0] == 0


def test_world_on_rails_waits_for_its_first_command_and_for_its_latency() -> None:
    ads = world_on_rails(first_command=0.2, latency=0.1)
    memory = ads.start(1, KNOWN, STEP)
    throttle = []
    for k in range(9):
        command, memory = ads.drive(seen(k * STEP, 0.0, FAR), memory)
        throttle.append(float(command.throttle[0]))
    assert throttle == [0.0] * 6 + [0.9] * 3, (
        "0.2 s is step 4, the command arrives two steps later"
    )


@pytest.mark.parametrize(("speed", "lag"), [(4.0, 0.1), (8.0, 0.1), (8.0, 0.6)])
def test_apollo_begins_where_a_comfortable_stop_and_the_way_lost_in_pedals_and_jerk_need_it(
    speed: float, lag: float
) -> None:
    """gap = stop gap + v^2 / (2 b) + v (lag + b / (2 jerk))."""
    expected = 5.0 + speed**2 / (2 * 2.0) + speed * (lag + 0.5 * 2.0 / 5.0)
    ads = apollo(pedal_lag=lag, cruise_speed=speed)
    memory = ads.start(1, KNOWN, STEP)
    for time in np.arange(0.0, 60.0 / speed, STEP).tolist():
        command, memory = ads.drive(seen(time, speed, 60.0 - speed * time), memory)
        if command.brake[0] > 0:
            break
    assert expected - 2.5 * speed * STEP < 60.0 - speed * time < expected + 1e-9


def test_apollo_asks_for_what_is_needed_to_stand_at_its_gap_through_the_originals_brake_table() -> (
    None
):
    """Beyond the jerk limit: deceleration b = v^2 / (2 (gap - stop gap)), at most the largest;
    pedal = (b - coasting) / braking.
    """
    ads = apollo(jerk=1e4)
    memory = ads.start(1, KNOWN, STEP)
    _, memory = ads.drive(seen(0.0, 8.0, 20.0), memory)
    for gap, deceleration in ((18.0, 64 / 26), (17.0, 64 / 24), (12.0, 3.0)):
        command, memory = ads.drive(seen(STEP, 8.0, gap), memory)
        assert command.brake[0] == pytest.approx((deceleration - COASTING) / BRAKING)
        assert command.throttle[0] == 0


@given(speed=st.floats(0, 20), gap=st.floats(0, 100))
def test_krauss_aims_at_the_speed_from_which_it_can_still_stop(
    speed: float, gap: float
) -> None:
    """v tau + v^2 / (2 b) = gap - standing gap, reached within a step and the vehicle's lag; at the
    end 0.5 m/s^2.
    """
    ads = Krauss()
    command, _ = ads.drive(seen(0.0, speed, gap), ads.start(1, KNOWN, STEP))
    b = 0.6 * KNOWN.decel
    room = max(gap - 2.5, 0.0)
    safe_speed = float(np.roots([1 / (2 * b), 1.0, -room]).max()) if room else 0.0
    safe_speed = max(safe_speed, room**0.5)
    acceleration = (min(safe_speed, 13.89) - speed) / (STEP + KNOWN.actuator_lag)
    assert command.throttle[0] == pytest.approx(
        min(max(acceleration / KNOWN.accel, 0), 1), abs=1e-6
    )
    assert command.brake[0] == pytest.approx(
        min(max(-acceleration / KNOWN.decel, 0), 1), abs=1e-6
    )


@SLOW
def test_autowares_emergency_stop_ends_where_the_ramp_of_jerk_says() -> None:
    speed = np.repeat([30, 40, 60], 2) / 3.6
    deceleration = np.tile([3.0, 2.5], 3)
    jerk = np.tile([3.0, 1.5], 3)
    ads = copy.copy(AutowareAeb())
    force_setattr(ads, "target_acceleration", deceleration)
    force_setattr(ads, "target_jerk", jerk)
    ramp = deceleration / jerk
    while_ramp = speed * ramp - jerk * ramp**3 / 6
    after = speed - jerk * ramp**2 / 2
    margins = (
        speed * ads.t_response
        + speed**2 / (2 * ads.a_ego_min)
        + ads.longitudinal_offset_margin
        - (speed * ads.command_delay + while_ramp + after**2 / (2 * deceleration))
    )
    assert margins == pytest.approx([3.6, -1.3, 4.5, -3.2, 6.1, -8.5], abs=0.06)
    gap = ads.distance(speed, np.zeros(6)) - 1e-9
    step = 0.001
    memory = ads.start(6, KNOWN, step)
    for sample in range(12_000):
        now = seen(sample * step, speed, gap, throttle=COASTING / (FULL + COASTING))
        command, memory = ads.drive(now, memory)
        pull = command.throttle * (FULL + COASTING) - COASTING - command.brake * BRAKING
        following = np.maximum(speed + pull * step, 0.0)
        gap = gap - (speed + following) / 2 * step
        speed = following
    assert gap == pytest.approx(margins, abs=0.01)
