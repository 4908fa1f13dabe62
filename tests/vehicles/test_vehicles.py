"""Every vehicle model: physics that no parameter may break, every characteristic acting as physics
says, and a steady state of every part that starts in motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.records import Command, FloatArray, JsonObject
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.vehicles import LEVEL, VEHICLES, _accelerations, slope_of
from safevar_sumo.vehicles.carla import ENGINE_INERTIA, WHEEL_MASS, WHEELS, Carla
from safevar_sumo.vehicles.lgsvl import Lgsvl
from safevar_sumo.vehicles.sensors import DelayedSignal
from tests.support.in_process import SLOW, own_network, write
from tests.support.made_up import original_of, seen, system_of
from tests.support.runs import (
    STEP,
    STUDY_OF,
    SYSTEMS,
    Drive,
    coasting_after,
    drawn,
    drive,
    ends,
    full_throttle,
    half_throttle,
    original,
    prepare,
)

MODELS = sorted(VEHICLES)


def kinetic_energy(model: str, run: Drive) -> FloatArray:
    """Kinetic energy of all moving parts [J], shape (T, N)."""
    p = run.prepared
    states = run.states
    if isinstance(SYSTEMS[model].vehicle, Carla):
        wheels_and_engine = [
            WHEELS * 0.5 * WHEEL_MASS * p.car.radius**2 * s.wheel_speed**2
            + ENGINE_INERTIA * s.engine_speed**2
            for s in states
        ]
        return np.stack(
            [
                (p.mass * s.speed**2 + spins) / 2
                for s, spins in zip(states, wheels_and_engine, strict=True)
            ]
        )
    if isinstance(SYSTEMS[model].vehicle, Lgsvl):
        return np.stack(
            [(p.body * s.speed**2 + p.inertia * s.wheel_speed**2) / 2 for s in states]
        )
    return np.stack([p.mass * s.speed**2 / 2 for s in states])


@pytest.mark.parametrize("model", MODELS)
def test_energy_is_never_created(model: str) -> None:
    """With pedals that change at random every second, the energy grows at most by the power of the
    engine; with the throttle closed it does not grow.
    """
    n = 300
    rng = default_rng(12)
    throttle = rng.choice([0.0, 0.4, 1.0], (8, n))
    brake = rng.choice([0.0, 0.0, 0.3, 1.0], (8, n))
    run = drive(
        model,
        drawn(model, n, 13),
        lambda time: (throttle[int(time)], brake[int(time)]),
        8,
    )
    energy = kinetic_energy(model, run)
    gained = np.diff(energy, axis=0)
    throttle = np.stack([state.throttle for state in run.states])
    closed = (throttle[1:] == 0) & (throttle[:-1] == 0)
    # The acceleration of SUMO's vehicle lags behind the throttle, which counts as closed when the
    # acceleration has died away.
    if model == "sumo":
        closed &= np.stack([state.acceleration for state in run.states[1:]]) <= 0
    assert np.count_nonzero(closed) > 1000
    assert np.all(gained[closed] <= 1e-9 * (1 + energy[:-1][closed]))
    strongest = {
        "carla": 2 * 500 * 7000 * np.pi / 30,
        "lgsvl": 550 * 13000 * np.pi / 30,
        "sumo": 3.2 * 2100 * 60,
        "worn": 3900.0 * 60,
    }[model]
    assert np.all(gained <= strongest * STEP)


# Measurements in which a characteristic acts, over a grid of its domain.
def speed_at(
    time: float,
    pedals: Callable[[float], tuple[float, float]] = full_throttle,
    road: float = 1.0,
) -> Callable[..., FloatArray]:
    return lambda model, population: drive(
        model, population, pedals, time, road=road
    ).speed[-1]


def stopping_distance(
    brake: float, road: float = 1.0, water: float = 0.0
) -> Callable[..., FloatArray]:
    return lambda model, population: drive(
        model,
        population,
        lambda time: (0.0, brake),
        15,
        rolling=8.0,
        road=road,
        water=water,
    ).distance[-1]


def coasting_loss(duration: float) -> Callable[..., FloatArray]:
    def measured(model: str, population: FloatArray) -> FloatArray:
        run = drive(model, population, coasting_after(3), duration + 3.5)
        before = run.speed[run.at(3.5)]
        return (before - run.speed[-1]) / before

    return measured


def lateral_error(model: str, population: FloatArray) -> FloatArray:
    return np.abs(drive(model, population, half_throttle, 3).states[-1].lateral)


ACTS = {
    "carla": {
        "max_rpm": (speed_at(30), +1),
        "dampRateFullT": (speed_at(1), -1),
        "dampRateZeroT_CE": (coasting_loss(2), +1),
        "dampRateZeroT_CD": (speed_at(0.8, half_throttle), -1),
        "gearSwitchTime": (speed_at(0.8), -1),
        "clutchStrength": (speed_at(0.65), +1),
        "mass": (speed_at(3), -1),
        "dragCoeff": (speed_at(1.5), -1),
        "tireFric": (stopping_distance(1.0), -1),
        "dampRate": (coasting_loss(2), +1),
        "radius": (stopping_distance(1.0), +1),
        "maxBrakeTorque": (stopping_distance(1.0), -1),
    },
    "lgsvl": {
        "mass": (speed_at(3), -1),
        "wheelMass": (speed_at(3), -1),
        "radius": (speed_at(2), -1),
        "maxRpm": (speed_at(60), +1),
        "minRpm": (speed_at(0.5), +1),
        "maxBrakeTorque": (stopping_distance(0.2), -1),
        "maxMotorTorque": (speed_at(3), +1),
        "maxSteeringAngle": (lateral_error, -1),
        "tireDragCoeff": (coasting_loss(5), +1),
        "wheelDamping": (coasting_loss(5), +1),
        "shiftTime": (speed_at(5), +1),
        "tractionControlSlipLimit": (speed_at(6, road=0.1), -1),
    },
    "sumo": {
        "mass": (speed_at(3), -1),
        "accel": (speed_at(3), +1),
        "decel": (stopping_distance(0.6), -1),
        "maxSpeed": (speed_at(60), +1),
        "actuatorLag": (speed_at(1), -1),
        "brakeDelay": (stopping_distance(0.6), +1),
        "brakeGain": (stopping_distance(0.6), -1),
    },
    "worn": {
        "treadDepth": (stopping_distance(1.0, road=0.85, water=1.0), -1),
        "brakeTorque": (stopping_distance(0.6), -1),
        "brakeResponse": (stopping_distance(0.6), +1),
        "payload": (stopping_distance(0.6), +1),
    },
}
SENSED = {
    "sumo": {"sensorRange", "reactionTime", "tau"},
    "worn": {"sensorRange", "sensorLatency", "payloadCentre"},
}
"""Characteristics that act on the observation, on the driver (test_ads.py), or on single axles
(test_worn.py).
"""


@pytest.mark.parametrize(
    ("model", "name"),
    [(model, name) for model, acting in ACTS.items() for name in acting],
)
def test_a_characteristic_acts_in_the_direction_that_physics_says(
    model: str, name: str
) -> None:
    measure, direction = ACTS[model][name]
    measured = direction * measure(model, ends(model, name))
    assert measured[-1] > measured[0]
    assert np.all(np.diff(measured) >= -1e-3 * np.abs(measured[1:]))


@pytest.mark.parametrize("model", MODELS)
def test_every_characteristic_is_tested_to_act(model: str) -> None:
    assert set(ACTS[model]) | SENSED.get(model, set()) == set(
        SYSTEMS[model].characteristics.names
    )


def test_what_comes_into_sight_is_where_it_is_whatever_was_before() -> None:
    for delay, sensed in ((0.0, 5.0), (0.1, np.inf)):
        unseen = DelayedSignal.of(np.array([np.inf]), np.array([delay]), 0.1)
        assert unseen.extended(np.array([5.0])).delayed().tolist() == [sensed]


def test_two_continuations_of_a_history_know_nothing_of_each_other() -> None:
    rng = default_rng(0)
    first = rng.random(3)
    histories = [DelayedSignal.of(first, np.array([0.0, 0.17, 0.4]), 0.1)] * 2
    samples = [[first] * 6, [first] * 6]
    for _ in range(100):  # more than a history has room for
        for one in (0, 1):
            samples[one].insert(0, rng.random(3))
            histories[one] = histories[one].extended(samples[one][0])
            (a, b, c), share = zip(*samples[one][:6], strict=True), 0.17 / 0.1 - 1
            assert histories[one].delayed() == pytest.approx(
                [a[0], b[1] * (1 - share) + b[2] * share, c[4]]
            )


def sensed_gaps(model: str, name: str) -> tuple[FloatArray, FloatArray]:
    """Five values of a characteristic, and the gaps that such vehicles report while an obstacle
    comes nearer at 10 m/s; shape (T, 5).
    """
    vehicle = SYSTEMS[model].vehicle
    population = ends(model, name)
    prepared = prepare(model, population)
    state = vehicle.at_rest(prepared)
    gaps = []
    for k in range(240):
        sensed, state = vehicle.sense(
            prepared, state, seen(k * STEP, 0.0, np.full(5, 130.0 - 10 * k * STEP))
        )
        gaps.append(sensed.gap)
    return population[:, SYSTEMS[model].characteristics.names.index(name)], np.stack(
        gaps
    )


@pytest.mark.parametrize("model", ["sumo", "worn"])
def test_a_sensor_sees_nothing_beyond_its_range(model: str) -> None:
    reach, gaps = sensed_gaps(model, "sensorRange")
    assert np.allclose(
        np.where(np.isfinite(gaps), gaps, 0).max(axis=0), reach, atol=0.6
    )


@pytest.mark.parametrize(
    ("model", "name"), [("sumo", "reactionTime"), ("worn", "sensorLatency")]
)
def test_a_slow_sensor_reports_the_past(model: str, name: str) -> None:
    latency, gaps = sensed_gaps(model, name)
    assert np.allclose(gaps[200], 130.0 - 10 * 200 * STEP + 10 * latency)


def test_a_drive_that_reaches_two_speeds_of_the_tables_has_an_acceleration() -> None:
    """0.3 m/s in each step of 0.1 s; the tables' second speed is 0.5 m/s."""
    assert _accelerations([0.0, 0.3, 0.6]) == pytest.approx(3.0)
    assert not _accelerations([0.0, 0.3]).any()


SPEEDS = (
    10,
    20,
    30,
    40,
    50,
    60,
)  # km/h, where the original vehicles' gearboxes hold their gear


@pytest.mark.parametrize("model", sorted(SYSTEMS))
@pytest.mark.parametrize(
    ("kmh", "grade"), [*((kmh, 0) for kmh in SPEEDS), (20, 6), (40, -3), (40, -12)]
)
def test_nothing_changes_while_the_pedals_stay(
    model: str, kmh: float, grade: float
) -> None:
    vehicle = SYSTEMS[model].vehicle
    prepared = prepare(model, original(model), grade=grade)
    before = state = vehicle.at_start(prepared, np.full(1, kmh / 3.6))
    assert state.speed == pytest.approx(kmh / 3.6)
    for _ in range(200):
        state = vehicle.advance(prepared, state, Command(before.throttle, before.brake))
    for name in (
        "speed",
        "wheel_speed",
        "engine_speed",
        "engine_rpm",
        "gear",
        "traction_torque",
    ):
        if hasattr(state, name):
            assert getattr(state, name) == pytest.approx(
                getattr(before, name), rel=1e-12
            ), name


@pytest.mark.parametrize("model", sorted(SYSTEMS))
def test_a_vehicle_that_starts_on_a_slope_too_slippery_to_hold_becomes_slower(
    model: str,
) -> None:
    vehicle = SYSTEMS[model].vehicle
    prepared = prepare(model, original(model), grade=12.0, road=0.03)
    state = vehicle.at_start(prepared, np.full(1, 10.0))
    assert vehicle.advance(prepared, state, Command(np.ones(1), np.zeros(1))).speed < 10


@SLOW
def test_the_depart_speed_of_the_traffic_is_honoured(tmp_path: Path) -> None:
    traffic = own_network(tmp_path / "net") / "traffic.rou.xml"
    head, vut, tail = traffic.read_text().partition('<vehicle id="vut"')
    traffic.write_text(
        head + vut + tail.replace('departSpeed="0"', 'departSpeed="5"', 1)
    )
    system = system_of("sun", scenario={"parameters": {"network": str(traffic.parent)}})
    trace = drive_worst(system, original_of(system)).trace
    assert trace.speed[0, 0] == 5
    assert abs(trace.speed[1, 0] - 5) < 0.3, (
        "no jump in the first step, whatever the system commands"
    )


G = 9.81
ANGLE = math.atan(0.08)


def test_a_grade_is_the_tangent_of_the_slopes_angle_and_none_is_level_to_the_bit() -> (
    None
):
    slope = slope_of(np.array([8.0, -8.0, 0.0]))
    assert slope.back == pytest.approx([G * math.sin(ANGLE), -G * math.sin(ANGLE), 0.0])
    assert slope.down == pytest.approx([G * math.cos(ANGLE), G * math.cos(ANGLE), G])
    assert (slope.back[2], slope.down[2]) == LEVEL


@pytest.mark.parametrize("model", sorted(SYSTEMS))
@pytest.mark.parametrize("grade", [8.0, -8.0])
def test_the_way_to_stop_is_v2_over_twice_what_the_tyres_hold_and_the_slope_adds(
    model: str, grade: float
) -> None:
    """On ice, where the tyres limit the deceleration to mu g cos; between 10 and 4 m/s, after the
    brake has built up.
    """

    def distance(grade: float) -> float:
        run = drive(
            model,
            original(model),
            lambda time: (0.0, 1.0),
            25.0,
            rolling=12.0,
            road=0.25,
            grade=grade,
        )
        return float(
            np.interp(-4.0, -run.speed[:, 0], run.distance[:, 0])
            - np.interp(-10.0, -run.speed[:, 0], run.distance[:, 0])
        )

    level = (10**2 - 4**2) / (2 * distance(0.0))
    expected = level * math.cos(ANGLE) + math.copysign(G * math.sin(ANGLE), grade)
    assert (10**2 - 4**2) / (2 * distance(grade)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("model", sorted(SYSTEMS))
@pytest.mark.parametrize("grade", [12.0, -12.0])
def test_whoever_stands_with_the_brake_on_stays_and_nobody_rolls_back(
    model: str, grade: float
) -> None:
    braked = drive(
        model, original(model), lambda time: (0.0, 1.0), 20.0, rolling=5.0, grade=grade
    )
    assert np.all(braked.speed[-100:] == 0)
    released = drive(
        model, original(model), lambda time: (0.0, 0.0), 3.0, grade=grade
    ).speed[-1, 0]
    assert released == 0 if grade > 0 else released > 1


@pytest.mark.parametrize("model", MODELS)
def test_a_thousand_times_too_much_is_another_unit(model: str) -> None:
    study = load_study(STUDY_OF[model])
    vehicle = SYSTEMS[model].vehicle
    assert {*vehicle.UNITS} <= {*vehicle.PLAUSIBLE}
    for name in vehicle.PLAUSIBLE:
        row = study.vehicle.characteristics.get(name)
        tables: JsonObject = {"parameters": {name: 1000 * getattr(vehicle, name, 0)}}
        if row is not None:
            ends = ("original", "lower", "upper")
            tables = {
                "characteristics": {
                    name: {end: 1000 * getattr(row, end) for end in ends}
                }
            }
        with pytest.raises(InputError, match=rf"vehicle\.\w+\.{name}"):
            system_of(study.name, name="another", vehicle=tables)


def test_an_own_vehicle_may_say_that_everything_is_plausible(in_tmp: Path) -> None:
    write(
        "own.py",
        "from safevar_sumo.vehicles.sensing import WornVehicle\n\nclass Own(WornVehicle,"
        " frozen=True, kw_only=True):\n    PLAUSIBLE = {}\n",
    )
    vehicle = {"model": "own:Own", "parameters": {"kerb_mass": 300}}
    characteristics = msgspec.to_builtins(load_study("wear").vehicle.characteristics)
    system = system_of(
        "wear", spread={}, vehicle={**vehicle, "characteristics": characteristics}
    )
    assert system.vehicle.kerb_mass == 300  # type: ignore[attr-defined]
