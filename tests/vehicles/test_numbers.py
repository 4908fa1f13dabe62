"""Numbers of the vehicle models, measured in their motion, CARLA's also by an integrator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.integrate import solve_ivp

from safevar_sumo.records import GRAVITY, Command
from safevar_sumo.vehicles.carla import (
    AIR_DENSITY,
    ENGINE_INERTIA,
    FRONTAL_AREA,
    RPM,
)
from safevar_sumo.vehicles.carla_step import FINAL_RATIO, GEAR_RATIOS
from safevar_sumo.vehicles.lgsvl import _tyre_stiffness
from tests.support.made_up import changed, seen
from tests.support.runs import (
    STEP,
    SYSTEMS,
    braking_after,
    drawn,
    drive,
    ends,
    full_throttle,
    original,
    prepare,
)

CARLA = SYSTEMS["carla"].vehicle


def prepared(model: str, **changes: float) -> Any:
    """The constants of one vehicle: the original with some characteristics changed."""
    return prepare(model, changed(SYSTEMS[model], **changes))


def step(model: str, state: Any, throttle: float = 0.0) -> Any:
    return SYSTEMS[model].vehicle.advance(
        prepared(model), state, Command(np.full(1, throttle), np.zeros(1))
    )


def test_air_slows_carlas_vehicle_by_half_rho_cd_a_v_squared() -> None:
    """In neutral, wheels rolling without damping: rho = 1.2 kg/m^3, A = 2.2 m^2."""
    slowed = []
    for drag in (0.2, 0.5):
        p = prepared("carla", dragCoeff=drag)
        state = CARLA.at_rest(p)._replace(
            speed=np.full(1, 20.0), wheel_speed=np.full(1, 20.0 / 0.355)
        )
        slowed.append(
            20.0
            - float(CARLA.advance(p, state, Command(np.zeros(1), np.zeros(1))).speed[0])
        )
    # The wheels' inertia takes part: four wheels of 20 kg, I / r^2 = 40 kg.
    assert slowed[1] - slowed[0] == pytest.approx(
        0.5 * 1.2 * 2.2 * 0.3 * 400 / (2404 + 40) * STEP, rel=0.02
    )


def test_carlas_gearbox_shifts_up_at_065_and_down_at_050_and_waits_two_seconds() -> (
    None
):
    # The values of sun are fitted.
    vehicle = replace(CARLA, shift_up=0.65, shift_down=0.5, shift_latency=2.0)
    values = SYSTEMS["carla"].characteristics.columns(original("carla"))
    p = vehicle.prepare(values, 1.0, 1 / 60)  # one substep
    limit = 5800 * 2 * np.pi / 60

    def target(gear: int, share: float, since: float = 2.0) -> float:
        one = np.ones(1)
        state = vehicle.at_rest(p)._replace(
            gear=gear * one,
            target_gear=gear * one,
            since_shift=since * one,
            throttle=one,
            engine_speed=share * limit * one,
        )
        return float(vehicle.advance(p, state, Command(one, 0 * one)).target_gear[0])

    assert [target(1, 0.649), target(1, 0.651), target(1, 0.651, 1.9)] == [1, 2, 1]
    assert [
        target(2, 0.501),
        target(2, 0.499),
        target(2, 0.499, 1.9),
        target(1, 0.1),
        target(4, 0.9),
    ] == [2, 1, 2, 1, 4]


def test_carlas_gearbox_shifts_as_soon_as_the_selector_lets_go_of_the_gear() -> None:
    """In first gear at 90 % of the engine's maximum: the gearbox waits while the selector holds the
    gear, and has no latency afterwards.
    """
    p = prepared("carla")
    one = np.ones(1)
    rim = 0.9 * 5800 * 2 * np.pi / 60 / (2.85 * 4)
    state = CARLA.at_rest(p)._replace(
        gear=one,
        target_gear=one,
        speed=rim * 0.355 * one,
        wheel_speed=rim * one,
        engine_speed=rim * 2.85 * 4 * one,
    )
    for _ in range(100):
        state = step("carla", CARLA.hold_gear(p, state, one > 0), throttle=1.0)
        assert state.target_gear[0] == 1
    assert (
        step("carla", CARLA.hold_gear(p, state, one < 0), throttle=1.0).target_gear[0]
        == 2
    )


@pytest.mark.parametrize(
    ("model", "told"),
    [
        (
            "carla",
            {
                "max_speed": 53.9045,
                "accel": 10.1634,
                "decel": 7.03054,
                "actuator_lag": 0.258097,
            },
        ),
        (
            "lgsvl",
            {"max_speed": 177.340, "accel": 6.47418, "decel": 9.81, "mass": 2120.0},
        ),
    ],
)
def test_sumo_is_told_what_a_vehicle_can_do(model: str, told: dict[str, float]) -> None:
    """CARLA's: 5800 r/min through 1.0 by 4.0 on wheels of 0.355 m; 500 N m times the engine's
    factor through 2.85 by 4; 4 * 1500 N m on 2404 kg. LGSVL's: 8299 r/min through 0.67 by 2.56 on
    wheels of 0.35 m; 450 N m through 4.17 by 2.56; brakes that reach g.
    """
    found = SYSTEMS[model].vehicle.sumo_type(prepared(model))
    assert {name: getattr(found, name)[0] for name in told} == pytest.approx(
        told, rel=1e-5
    )


def test_lgsvls_gearbox_and_traction_control_have_their_numbers() -> None:
    """At least 0.7 s between changes; torque from 0.325 of the largest, by 337.5 N m/s."""
    states = drive("lgsvl", original("lgsvl"), full_throttle, 12).states
    changes = (
        np.flatnonzero(np.diff(np.array([float(state.gear[0]) for state in states])))
        * STEP
    )
    assert len(changes) > 2
    assert np.diff(changes).min() >= 0.7 - STEP / 2
    torque = [float(state.traction_torque[0]) for state in states[:4]]
    assert torque == pytest.approx([0.325 * 450 + 337.5 * STEP * k for k in range(4)])


@pytest.mark.parametrize(
    ("share", "gear"), [(0.12, 2), (0.14, 3), (0.32, 3), (0.34, 4)]
)
def test_lgsvls_gearbox_shifts_up_at_033_and_down_at_013_of_the_engines_maximum(
    share: float, gear: int
) -> None:
    """From third gear, 8299 r/min at most."""
    one = np.ones(1)
    state = (
        SYSTEMS["lgsvl"]
        .vehicle.at_rest(prepared("lgsvl"))
        ._replace(
            speed=5 * one,
            wheel_speed=5 / 0.35 * one,
            gear=3 * one,
            old_ratio=2.11 * one,
            new_ratio=2.11 * one,
            engine_rpm=share * 8299 * one,
        )
    )
    assert step("lgsvl", state).gear[0] == gear


@pytest.mark.parametrize(
    ("slip", "share"), [(0.2, 0.75), (0.4, 1.0), (0.6, 0.75), (0.8, 0.5), (0.95, 0.5)]
)
def test_lgsvls_tyres_follow_unitys_curve(slip: float, share: float) -> None:
    """A parabola up to the extremum at slip 0.4, a line down to half of it at 0.8; load with 2 v^2
    N of downforce.
    """
    p = prepared("lgsvl")
    rim = 10.0
    one = np.ones(1)
    speed = rim * (1 - slip)
    stiffness = _tyre_stiffness(p, speed * one, rim * one, (rim - speed) * one)
    force = float(stiffness[0]) * (rim - speed)
    assert force == pytest.approx(share * (2120 * GRAVITY + 2 * speed * speed))


@pytest.mark.parametrize(
    ("visibility", "is_seen"), [(1.0, True), (0.8, True), (0.7, False)]
)
def test_sumos_sensor_sees_less_far_in_bad_sight(
    visibility: float, is_seen: bool
) -> None:
    vehicle = SYSTEMS["sumo"].vehicle
    p = prepared("sumo")
    result, _ = vehicle.sense(
        p, vehicle.at_rest(p), seen(0.0, 1.0, 60.0, visibility=visibility)
    )
    assert bool(np.isfinite(result.gap[0])) == is_seen, "80 m in clear sight"


def test_a_braked_sumo_vehicle_does_not_go_on_speeding_up_during_the_lag() -> None:
    """A lag of 0.5 s leaves most of full throttle's acceleration to the next step; a tenth of the
    brake ends it at once.
    """
    vehicle = SYSTEMS["sumo"].vehicle
    p = prepared("sumo", actuatorLag=0.5, brakeDelay=1e-9)
    state = vehicle.at_rest(p)
    for _ in range(40):
        state = vehicle.advance(p, state, Command(np.ones(1), np.zeros(1)))
    released, braked = (
        vehicle.advance(p, state, Command(np.zeros(1), np.full(1, brake)))
        for brake in (0.0, 0.1)
    )
    assert released.speed[0] > state.speed[0]
    assert braked.speed[0] <= state.speed[0]


def test_a_calibration_drive_finds_what_the_brake_adds_to_coasting() -> None:
    """SUMO's vehicle coasts without loss and brakes at decel, 9 m/s^2, per unit of pedal."""
    assert SYSTEMS["sumo"].nominal.braking == pytest.approx(9.0, rel=0.02)


def tyre_force(friction: float, load: float, speed: float, rim: float) -> float:
    """Force of four tyres [N], from the shader's cubic as PhysX writes it."""
    slip = (rim - speed) / (max(rim, speed) + CARLA.slip_offset)
    k = min(
        4 * GRAVITY * CARLA.longitudinal_stiffness * abs(slip) / (friction * load), 3.0
    )
    return float(np.sign(slip) * friction * load * (k - k * k / 3 + k**3 / 27))


@pytest.mark.parametrize("setting", drawn("carla", 5, 21), ids=range(5))
def test_driving_and_braking_follow_the_differential_equations(
    setting: np.ndarray,
) -> None:
    """Stated bound: 0.1 m/s against an adaptive integrator with a tolerance of 1e-8, from the first
    gear on until 0.5 m/s.
    """
    values = dict(zip(SYSTEMS["carla"].characteristics.names, setting, strict=True))
    run = drive("carla", setting[np.newaxis], braking_after(1.4), 2.8)
    radius = values["radius"] / 100
    mass = values["mass"]
    limit = values["max_rpm"] * RPM
    ratio = GEAR_RATIOS[1] * FINAL_RATIO
    friction = CARLA.tyre_friction * values["tireFric"]

    def changes(time: float, state: np.ndarray) -> list[float]:
        speed, wheel, engine = state
        throttle = max(1 - CARLA.throttle_fall * max(time - 1.4, 0), 0.0)
        brake = min(CARLA.brake_rise * max(time - 1.4, 0), 1.0)
        x = engine / limit
        torque = (
            CARLA.engine_torque
            * min(
                400 + 100 * x * 5800 / 1890,
                500 - 100 * (x * 5800 - 1890) / (5730 - 1890),
            )
            * (x <= 1)
        )
        damping = (
            values["dampRateZeroT_CE"]
            + (values["dampRateFullT"] - values["dampRateZeroT_CE"]) * throttle
        )
        clutch = values["clutchStrength"] * (engine - ratio * wheel)
        force = tyre_force(friction, mass * GRAVITY, speed, radius * wheel)
        braking = brake * 4 * values["maxBrakeTorque"] * np.tanh(wheel / 0.01)
        return [
            (
                force
                - 0.5 * AIR_DENSITY * FRONTAL_AREA * values["dragCoeff"] * speed * speed
            )
            / mass,
            (ratio * clutch - 4 * values["dampRate"] * wheel - braking - radius * force)
            / (4 * 0.5 * 20 * radius * radius),
            (throttle * torque - damping * engine - clutch) / ENGINE_INERTIA,
        ]

    begin = next(
        k for k, state in enumerate(run.states) if state.gear[0] > 0 and k * STEP >= 0.8
    )
    first = run.states[begin]
    times = np.arange(begin, len(run.states)) * STEP
    exact = solve_ivp(
        changes,
        (times[0], times[-1]),
        [first.speed[0], first.wheel_speed[0], first.engine_speed[0]],
        t_eval=times,
        method="LSODA",
        rtol=1e-8,
        atol=1e-8,
        max_step=0.01,
    ).y[0]
    simulated = run.speed[begin:, 0]
    moving = exact > 0.5
    assert np.count_nonzero(moving & (times > 1.7)) > 5, (
        "the vehicle brakes for some time"
    )
    assert np.abs(simulated - exact)[moving].max() < 0.1


def test_a_camera_on_smaller_wheels_overestimates_the_gap() -> None:
    population = ends("carla", "radius")
    constants = prepare("carla", population)
    result, _ = CARLA.sense(
        constants, CARLA.at_rest(constants), seen(0.0, 0.0, np.full(5, 8.0))
    )
    assert np.all(np.diff(result.gap) < 0)
    assert np.interp(35.5, population[:, 10], result.gap) == pytest.approx(
        8.0, rel=1e-3
    )
