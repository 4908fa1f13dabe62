"""The vehicle of CARLA against second implementations of PhysX's equations, and against its constants."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from safevar_sumo.records import GRAVITY, Command, Observation
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles.carla import (
    AIR_DENSITY,
    ENGINE_INERTIA,
    FINAL_RATIO,
    FRONTAL_AREA,
    GEAR_RATIOS,
    RPM,
    WHEELS,
    Carla,
)
from tests.vehicles.runs import STEP, SYSTEMS, braking_after, drawn, drive, ends, original


def carla() -> Carla:
    vehicle = SYSTEMS["carla"].vehicle
    assert isinstance(vehicle, Carla)
    return vehicle


def tyre_force(vehicle: Carla, friction: float, load: float, speed: float, rim: float) -> float:
    """Force of four tyres [N], from the shader's cubic as PhysX writes it."""
    slip = (rim - speed) / (max(rim, speed) + vehicle.slip_offset)
    k = min(4 * GRAVITY * vehicle.longitudinal_stiffness * abs(slip) / (friction * load), 3.0)
    return float(np.sign(slip) * friction * load * (k - k * k / 3 + k**3 / 27))


@pytest.mark.parametrize("study", ["sun", "rain"])
def test_vehicles_of_the_domain_reach_the_speed_up_to_which_the_vehicle_was_fitted_and_no_more(study: str) -> None:
    runs = simulate(assemble(load_study(study)), drawn("carla", 1000, 3))
    assert 0.9 * Carla.FITTED_UP_TO < runs.trace.speed.max() <= Carla.FITTED_UP_TO


def test_driving_and_braking_follow_the_differential_equations() -> None:
    """Stated bound: 0.1 m/s against an adaptive integrator with a tolerance of 1e-8, from the first gear on until 0.5
    m/s.
    """
    vehicle, pedals = carla(), braking_after(1.4)
    for setting in drawn("carla", 5, 21):
        values = dict(zip(SYSTEMS["carla"].characteristics.names, setting, strict=True))
        run = drive("carla", setting[np.newaxis], pedals, 2.8)
        radius, mass, limit = values["radius"] / 100, values["mass"], values["max_rpm"] * RPM
        ratio, friction = GEAR_RATIOS[1] * FINAL_RATIO, vehicle.tyre_friction * values["tireFric"]

        def changes(
            time: float,
            state: np.ndarray,
            values: dict[str, float] = values,
            ratio: float = ratio,
            mass: float = mass,
            radius: float = radius,
            limit: float = limit,
            friction: float = friction,
        ) -> list[float]:
            speed, wheel, engine = state
            throttle = max(1 - vehicle.throttle_fall * max(time - 1.4, 0), 0.0)
            brake = min(vehicle.brake_rise * max(time - 1.4, 0), 1.0)
            x = engine / limit
            torque = (
                vehicle.engine_torque
                * min(400 + 100 * x * 5800 / 1890, 500 - 100 * (x * 5800 - 1890) / (5730 - 1890))
                * (x <= 1)
            )
            damping = values["dampRateZeroT_CE"] + (values["dampRateFullT"] - values["dampRateZeroT_CE"]) * throttle
            clutch = values["clutchStrength"] * (engine - ratio * wheel)
            force = tyre_force(vehicle, friction, mass * GRAVITY, speed, radius * wheel)
            braking = brake * 4 * values["maxBrakeTorque"] * np.tanh(wheel / 0.01)
            return [
                (force - 0.5 * AIR_DENSITY * FRONTAL_AREA * values["dragCoeff"] * speed * speed) / mass,
                (ratio * clutch - 4 * values["dampRate"] * wheel - braking - radius * force)
                / (4 * 0.5 * 20 * radius * radius),
                (throttle * torque - damping * engine - clutch) / ENGINE_INERTIA,
            ]

        begin = next(k for k, state in enumerate(run.states) if state.gear[0] > 0 and k * STEP >= 0.8)
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
        assert np.count_nonzero(moving & (times > 1.7)) > 5, "the vehicle brakes for some time"
        assert np.abs(simulated - exact)[moving].max() < 0.1


def test_a_camera_on_smaller_wheels_overestimates_the_gap() -> None:
    vehicle, population = carla(), ends("carla", "radius")
    values = dict(zip(SYSTEMS["carla"].characteristics.names, np.ascontiguousarray(population.T), strict=True))
    prepared = vehicle.prepare(values, 1.0, STEP)
    nothing = np.zeros(5)
    seen, _ = vehicle.sense(
        prepared, vehicle.at_rest(prepared), Observation(0.0, nothing, nothing + 8, nothing, nothing, nothing, 1.0)
    )
    assert np.all(np.diff(seen.gap) < 0)
    assert np.interp(35.5, population[:, 10], seen.gap) == pytest.approx(8.0, rel=1e-3)


def test_carla_shifts_up_above_its_engine_speed_and_not_before_its_latency() -> None:
    """The first switch begins with the first substep of 1/60 s and takes 0.5 s; so does the next, spent in neutral
    too.
    """
    values = dict(zip(SYSTEMS["carla"].characteristics.names, np.ascontiguousarray(original("carla").T), strict=True))
    gears = {}
    for up in (0.3, 0.6):
        vehicle = msgspec.structs.replace(carla(), shift_up=up, shift_latency=1.0)
        prepared = vehicle.prepare(values, 1.0, STEP)
        states = [vehicle.at_rest(prepared)]
        while len(states) <= 32:
            states.append(vehicle.advance(prepared, states[-1], Command(np.ones(1), np.zeros(1))))
        gears[up] = [int(state.gear[0]) for state in states]
    assert gears[0.3] == [0] * 11 + [1] * 10 + [0] * 10 + [2] * 2
    assert gears[0.6][:23] == [0] * 11 + [1] * 12


SPEED, UNTIL = 15.0, 2.0
"""Speeds between which the tests compare the mean deceleration [m/s]."""

SLOW = pytest.mark.slow


def multi_body(deceleration: float, **changed: float) -> float:
    """Mean deceleration for the brake torque that would give `deceleration` to the unchanged vehicle on rigid wheels
    [m/s^2].
    """
    from scipy.integrate import solve_ivp
    from vehiclemodels.init_mb import init_mb
    from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

    unchanged, vehicle = parameters(), parameters()
    for name, value in changed.items():
        setattr(vehicle.tire if name == "p_dx1" else vehicle, name, value)
    torque = -deceleration * unchanged.m * unchanged.R_w / (vehicle.m * vehicle.R_w)  # its input is a torque over m R_w

    def slow(_: float, x: Any) -> Any:
        return x[3] - UNTIL

    slow.terminal = True  # type: ignore[attr-defined]
    result = solve_ivp(
        lambda _, x: vehicle_dynamics_mb(list(x), [0.0, torque], vehicle),
        (0, 12),
        init_mb([0, 0, 0, SPEED, 0, 0, 0], vehicle),
        events=slow,
        max_step=0.01,
        rtol=1e-4,
    )
    return float((SPEED - result.y[3, -1]) / result.t[-1])


def parameters() -> Any:
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2

    return parameters_vehicle2()


def carla_deceleration(deceleration: float, **changed: float) -> float:
    """Mean deceleration of the vehicle of CARLA for the same brake torque [m/s^2]."""
    reference = parameters()
    mass, radius = changed.get("m", reference.m), changed.get("R_w", reference.R_w)
    vehicle = Carla(
        tyre_friction=1.0,
        longitudinal_stiffness=reference.tire.p_kx1 * mass / WHEELS,
        slip_offset=0.1,
        engine_torque=1.0,
        brake_rise=1e3,
        camera_height=1.0,
    )
    values = {
        "max_rpm": 5800.0,
        "dampRateFullT": 0.15,
        "dampRateZeroT_CE": 2.0,
        "dampRateZeroT_CD": 0.35,
        "gearSwitchTime": 0.5,
        "clutchStrength": 10.0,
        "mass": mass,
        "dragCoeff": 0.0,
        "tireFric": changed.get("p_dx1", reference.tire.p_dx1),
        "dampRate": 0.0,
        "radius": 100 * radius,
        "maxBrakeTorque": deceleration * reference.m * reference.R_w / WHEELS,
    }
    step = 0.005
    prepared = vehicle.prepare({name: np.full(1, value) for name, value in values.items()}, 1.0, step)
    neutral = np.zeros(1)
    state = vehicle.at_rest(prepared)._replace(speed=neutral + SPEED, wheel_speed=neutral + SPEED / radius)
    time = 0.0
    while state.speed[0] > UNTIL:
        state = vehicle.advance(prepared, state, Command(neutral, neutral + 1))
        time += step
    return float((SPEED - state.speed[0]) / time)


@SLOW
@pytest.mark.parametrize("deceleration", [2.0, 6.0, 8.0])
def test_below_the_limit_both_brake_alike(deceleration: float) -> None:
    """Within 3 %: the wheels of the multi-body model are heavier (1.7 against 1.2 kg m^2 each) and slow down a little
    later.
    """
    assert carla_deceleration(deceleration) == pytest.approx(multi_body(deceleration), rel=0.03)


@SLOW
@pytest.mark.parametrize(("name", "factor"), [("m", 1.2), ("R_w", 0.9)])
def test_mass_and_radius_act_alike(name: str, factor: float) -> None:
    """In both models, the ratio of decelerations with and without the change agrees with the closed form within 2 %."""
    changed = {name: factor * getattr(parameters(), name)}
    for model in (carla_deceleration, multi_body):
        assert model(5.0, **changed) / model(5.0) == pytest.approx(1 / factor, rel=0.02)


@SLOW
@pytest.mark.parametrize(("friction", "least_share"), [(0.8, 0.6), (0.5, 0.55)])
def test_beyond_the_limit_carla_keeps_the_friction_that_the_multi_body_model_loses(
    friction: float, least_share: float
) -> None:
    """Friction limits both models. PhysX's tyre keeps its friction when the wheels lock; Pacejka's tyre loses up to a
    half.
    """
    limit = friction * GRAVITY
    assert carla_deceleration(9.5, p_dx1=friction) == pytest.approx(limit, rel=0.03)
    assert least_share * limit < multi_body(9.5, p_dx1=friction) < limit


@SLOW
def test_a_brake_split_matters_only_at_the_limit() -> None:
    """The vehicle of CARLA has no brake split: its four wheels share the load and brake as one."""
    assert multi_body(5.0, T_sb=0.5) == pytest.approx(multi_body(5.0, T_sb=0.8), rel=0.02)
    near_the_limit = [multi_body(9.0, T_sb=split) for split in (0.5, 0.66, 0.8)]
    assert max(near_the_limit) / min(near_the_limit) > 1.1
    assert min(near_the_limit) > 0.7 * carla_deceleration(9.0)
