"""The vehicle of CARLA against second implementations of PhysX's equations, and against its constants."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from safevar_sumo.records import Command, Observation
from safevar_sumo.vehicles.carla import AIR_DENSITY, ENGINE_INERTIA, FINAL_RATIO, FRONTAL_AREA, GEAR_RATIOS, GRAVITY, RPM, Carla
from tests.vehicles.drives import STEP, SYSTEMS, braking_after, drawn, drive, ends, full_throttle, original


def carla() -> Carla:
    vehicle = SYSTEMS["carla"].vehicle
    assert isinstance(vehicle, Carla)
    return vehicle


def tyre_force(vehicle: Carla, friction: float, load: float, speed: float, rim: float) -> float:
    """Of four tyres, from the shader's cubic as PhysX writes it."""
    slip = (rim - speed) / (max(rim, speed) + vehicle.slip_offset)
    k = min(4 * GRAVITY * vehicle.longitudinal_stiffness * abs(slip) / (friction * load), 3.0)
    return float(np.sign(slip) * friction * load * (k - k * k / 3 + k**3 / 27))


def test_driving_and_braking_follow_the_differential_equations() -> None:
    """Stated bound: 0.1 m/s against an adaptive integrator with a tolerance of 1e-8, from the first gear on until 0.5 m/s."""
    vehicle, pedals = carla(), braking_after(1.4)
    for setting in drawn("carla", 5, 21):
        values = dict(zip(SYSTEMS["carla"].characteristics.names, setting, strict=True))
        run = drive("carla", setting[np.newaxis], pedals, 2.8)
        radius, mass, limit = values["radius"] / 100, values["mass"], values["max_rpm"] * RPM
        ratio, friction = GEAR_RATIOS[1] * FINAL_RATIO, vehicle.tyre_friction * values["tireFric"]

        def changes(time: float, state: np.ndarray, values: dict[str, float] = values, ratio: float = ratio, mass: float = mass,
                    radius: float = radius, limit: float = limit, friction: float = friction) -> list[float]:
            speed, wheel, engine = state
            throttle = max(1 - 10 * max(time - 1.4, 0), 0.0)
            brake = min(vehicle.brake_rise * max(time - 1.4, 0), 1.0)
            x = engine / limit
            torque = vehicle.engine_torque * min(400 + 100 * x * 5800 / 1890, 500 - 100 * (x * 5800 - 1890) / (5730 - 1890)) * (x <= 1)
            damping = values["dampRateZeroT_CE"] + (values["dampRateFullT"] - values["dampRateZeroT_CE"]) * throttle
            clutch = values["clutchStrength"] * (engine - ratio * wheel)
            force = tyre_force(vehicle, friction, mass * GRAVITY, speed, radius * wheel)
            braking = brake * 4 * values["maxBrakeTorque"] * np.tanh(wheel / 0.01)
            return [(force - 0.5 * AIR_DENSITY * FRONTAL_AREA * values["dragCoeff"] * speed * speed) / mass,
                    (ratio * clutch - 4 * values["dampRate"] * wheel - braking - radius * force) / (4 * 0.5 * 20 * radius * radius),
                    (throttle * torque - damping * engine - clutch) / ENGINE_INERTIA]

        begin = next(k for k, state in enumerate(run.states) if state.gear[0] > 0 and k * STEP >= 0.8)
        first = run.states[begin]
        times = np.arange(begin, len(run.states)) * STEP
        exact = solve_ivp(changes, (times[0], times[-1]), [first.speed[0], first.wheel_speed[0], first.engine_speed[0]],
                          t_eval=times, method="LSODA", rtol=1e-8, atol=1e-8, max_step=0.01).y[0]
        here = run.speed[begin:, 0]
        moving = exact > 0.5
        assert np.count_nonzero(moving & (times > 1.7)) > 5, "it brakes a while"
        assert np.abs(here - exact)[moving].max() < 0.1


def test_a_camera_on_smaller_wheels_overestimates_the_gap() -> None:
    vehicle, population = carla(), ends("carla", "radius")
    values = dict(zip(SYSTEMS["carla"].characteristics.names, np.ascontiguousarray(population.T), strict=True))
    prepared = vehicle.prepare(values, 1.0, STEP)
    nothing = np.zeros(5)
    seen, _ = vehicle.sense(prepared, vehicle.at_rest(prepared), Observation(0.0, nothing, nothing + 8, nothing, nothing, nothing, 1.0))
    assert np.all(np.diff(seen.gap) < 0)
    assert np.interp(35.5, population[:, 10], seen.gap) == pytest.approx(8.0, rel=1e-3)


def test_carla_waits_in_neutral_for_its_first_gear() -> None:
    """A switch takes gearSwitchTime, counted in substeps of 1/60 s: 33 of them for 0.55 s, 34 for anything above."""
    settings_ = original("carla", 2)
    settings_[:, 4] = [0.55, 0.5501]
    gears = np.stack([state.gear for state in drive("carla", settings_, full_throttle, 0.7).states])
    assert np.argmax(gears[:, 0] > 0) == 12  # substep 33 lies in the frame that ends at 0.6 s
    assert np.argmax(gears[:, 1] > 0) == 12
    speeds = drive("carla", settings_, full_throttle, 0.6).speed[-1]
    assert speeds[0] > speeds[1]


def test_carla_shifts_up_above_its_engine_speed_and_not_before_its_latency() -> None:
    """The first switch begins with the first substep of 1/60 s and takes 0.5 s; so does the next, spent in neutral too."""
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
