"""CommonRoad's multi-body vehicle with Pacejka's tyres, driving straight, with an anti-lock controller.

The equations are those of `vehicle_dynamics_mb` of commonroad-vehicle-models (Althoff and Würsching, "CommonRoad: Vehicle Models", 2020)
for a vehicle that neither steers nor rolls: body, pitch and heave, two axles on springs, and the wheels of each axle. The package computes
one vehicle at a time with all 29 states; this module computes the 11 states that change, for N vehicles at once.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import Slope

WHEELS = 4
STEP = 1e-3
"""Longest step of the integration [s]: 0.08 rad of the fastest motion, an axle between its springs and its tyres (75 rad/s)."""
LEAST_SPEED = 0.1
"""Smallest speed to which slip is relative [m/s]: half of `v_s` in the package's `vehicle_dynamics_std`."""
SLIP_LIMIT, LEAST_CONTROL_SPEED = 0.1, 2.0
"""Slip above which the anti-lock controller releases brake pressure [-], and speed above which the controller acts [m/s].

Real controllers work between 0.1 and 0.2 from about 7 km/h on (Bosch, Automotive Handbook, "Antilock braking system").
"""
RELEASE, BUILD_UP = 25.0, 8.0
"""Rates at which the controller releases and restores pressure [1/s], as shares of full pressure; valves release faster than they restore.

Chosen values: braking uses at least 0.78 of the friction, for coefficients from 0.2 to 1 (tests). UN Regulation 13-H, annex 6, requires
0.75.
"""


def commonroad() -> Any:
    """Parameters of the package's vehicle 2, a BMW 320i, and of its tyres.

    Raises
    ------
    InputError
        If the package is not installed.
    """
    try:
        from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
    except ImportError:
        raise InputError("opinion", "commonroad-vehicle-models, the second vehicle model, is not installed",
                         "pip install 'safevar_sumo[opinion]'") from None
    return _parameters(parameters_vehicle2)


@cache
def _parameters(load_parameters: Any) -> Any:
    return load_parameters()


@cache
def _tyre() -> Any:
    return commonroad().tire


class Plant(NamedTuple):
    """Constants of N vehicles, SI, after the package's m, m_s, m_uf, m_ur, a, b, h_s, I_y_s, K_sf, K_sdf, K_zt, R_w, I_y_w.

    Shape (N,), or (2, N) for values per axle, front before rear: `arms`, a and -b; `static_shares` of the sprung mass; `springs` and
    `dampers` of each wheel; `brake_shares`, T_sb and 1 - T_sb; `drive_shares`, T_se and 1 - T_se. `unsprung_mass` is one axle's,
    `friction` Pacejka's p_dx1, `brake_torque` the torque of all wheels at full pedal; `back` and `down` are the road slope's accelerations.
    """

    mass: FloatArray
    sprung_mass: FloatArray
    unsprung_mass: FloatArray
    arms: FloatArray
    static_shares: FloatArray
    height: FloatArray
    pitch_inertia: FloatArray
    springs: FloatArray
    dampers: FloatArray
    tyre_spring: FloatArray
    radius: FloatArray
    wheel_inertia: FloatArray
    friction: FloatArray
    brake_torque: FloatArray
    brake_shares: FloatArray
    drive_shares: FloatArray
    back: FloatArray
    down: FloatArray


def plant_of(mass: FloatArray, unladen_mass: float, slope: Slope, *, brake_front: float, drive_front: float,
             centre: FloatArray | None = None, wheelbase: float | None = None, height: float | None = None, **others: Any) -> Plant:
    """Vehicles with masses [kg] that differ from the package's vehicle.

    Unsprung masses, springs, dampers, tyres and inertia grow with `unladen_mass` [kg], so that all frequencies stay the package's;
    a load rests on the springs. `centre` is the whole vehicle's centre of mass behind the front axle [m], `height` its height above the
    road [m]; the package's values replace None.
    """
    p = commonroad()
    ones, scale = np.ones_like(mass), unladen_mass / p.m
    unsprung_mass = scale * p.m_uf * ones
    sprung_mass, length = mass - 2 * unsprung_mass, p.a + p.b if wheelbase is None else wheelbase
    front = (p.a / (p.a + p.b)) * length * ones if centre is None else (mass * centre - unsprung_mass * length) / sprung_mass
    values = {name: np.asarray(value, dtype=float) * ones for name, value in others.items()}
    plant = Plant(
        mass=mass, sprung_mass=sprung_mass, unsprung_mass=unsprung_mass, arms=np.stack([front, front - length]),
        static_shares=np.stack([length - front, front]) / length, height=(p.h_s if height is None else height) * ones,
        pitch_inertia=scale * p.I_y_s * ones * (length / (p.a + p.b)) ** 2, springs=scale * np.stack([p.K_sf * ones, p.K_sr * ones]),
        dampers=scale * np.stack([p.K_sdf * ones, p.K_sdr * ones]), tyre_spring=scale * p.K_zt * ones,
        brake_shares=np.stack([brake_front * ones, (1 - brake_front) * ones]),
        drive_shares=np.stack([drive_front * ones, (1 - drive_front) * ones]), back=slope.back * ones, down=slope.down * ones, **values)
    return plant._replace(height=plant.height + at_speed(plant, ones).heave)  # the body's heights count from unloaded tyres


class MultiBody(NamedTuple):
    """State of N vehicles, SI: speed, pitch and heave of the body with their rates, shape (N,); of the axles, front before rear, height,
    its rate, the wheels' speed [rad/s] and the share of full pressure that the anti-lock controller allows, shape (2, N).

    Heights count downwards, as in the package.
    """

    speed: FloatArray
    pitch: FloatArray
    pitch_rate: FloatArray
    heave: FloatArray
    heave_rate: FloatArray
    heights: FloatArray
    height_rates: FloatArray
    wheels: FloatArray
    pressure_shares: FloatArray


def at_speed(plant: Plant, speed: FloatArray) -> MultiBody:
    """The body in static balance on its springs, with rolling wheels."""
    zeros, axle_zeros = np.zeros_like(plant.mass), np.zeros_like(plant.arms)
    heights = (plant.sprung_mass * plant.static_shares + plant.unsprung_mass) * plant.down / (2 * plant.tyre_spring)
    # The springs carry the static load without deflection if, above each axle, the body is as high as the axle.
    heave, pitch = (heights * plant.static_shares).sum(axis=0), (heights[1] - heights[0]) / (plant.arms[0] - plant.arms[1])
    return MultiBody(speed, pitch, zeros, heave, zeros, heights, axle_zeros, axle_zeros + speed / plant.radius, axle_zeros + 1)


class Forces(NamedTuple):
    """One tyre of each axle, shape (2, N): the force along the road [N], its derivative `gradient` by the wheel's speed
    [N s/rad], and the slip [-], positive when braking.
    """

    force: FloatArray
    gradient: FloatArray
    slip: FloatArray


def tyre_forces(plant: Plant, body: MultiBody) -> Forces:
    """Pacejka's formula for pure longitudinal slip, as in the package's `formula_longitudinal`, and its derivative."""
    tyre, slip_speed = _tyre(), np.maximum(body.speed, LEAST_SPEED)
    load = np.maximum(body.heights * plant.tyre_spring, 1.0)
    slip = (body.speed - plant.radius * body.wheels) / slip_speed
    peak, stiffness = plant.friction * load, tyre.p_kx1 / (tyre.p_cx1 * plant.friction)
    scaled_slip = stiffness * (tyre.p_hx1 - slip)
    curve = (1 - tyre.p_ex1) * scaled_slip + tyre.p_ex1 * np.arctan(scaled_slip)
    angle = tyre.p_cx1 * np.arctan(curve) + load * tyre.p_vx1
    slope = peak * np.cos(angle) * (tyre.p_cx1 / (1 + curve * curve)) * (1 - tyre.p_ex1 + tyre.p_ex1 / (1 + scaled_slip * scaled_slip))
    return Forces(peak * np.sin(angle), slope * (stiffness * plant.radius / slip_speed), slip)


class Rates(NamedTuple):
    """Time derivatives of a body's speed, rates and wheel speeds, SI; shapes as in `MultiBody`."""

    speed: FloatArray
    pitch_rate: FloatArray
    heave_rate: FloatArray
    height_rates: FloatArray
    wheels: FloatArray


def rates(plant: Plant, body: MultiBody, torques: FloatArray, forces: Forces) -> Rates:
    """The right-hand side of the package's equations; `torques`, shape (2, N), turn both wheels of an axle forward [N m]."""
    p, traction = plant, 2 * (forces.force[0] + forces.force[1])
    deflection = body.heights - body.heave + p.arms * body.pitch
    deflection_rate = body.height_rates - body.heave_rate + p.arms * body.pitch_rate
    springs = p.sprung_mass * p.down * p.static_shares / 2 - deflection * p.springs - deflection_rate * p.dampers
    moments = p.arms * springs
    return Rates(
        speed=traction / p.mass - p.back,
        pitch_rate=(2 * (moments[0] + moments[1]) + traction * (p.height - body.heave)) / p.pitch_inertia,
        heave_rate=p.down - 2 * (springs[0] + springs[1]) / p.sprung_mass,
        height_rates=p.down - 2 * (body.heights * p.tyre_spring - springs) / p.unsprung_mass,
        wheels=(torques / 2 - p.radius * forces.force) / p.wheel_inertia)


def advance(plant: Plant, body: MultiBody, pedal: FloatArray, drive_torque: FloatArray, step: float) -> MultiBody:
    """One integration step under a brake pedal (0 to 1) and a torque of engine and drags on all wheels [N m].

    Wheel speeds, which are stiff, are integrated implicitly (linearised), all other states explicitly, rates before heights.
    """
    p, forces = plant, tyre_forces(plant, body)
    pressure_shares = _anti_lock(body, forces.slip, pedal, step)
    change = rates(p, body, drive_torque * p.drive_shares - np.minimum(pedal, pressure_shares) * (p.brake_torque * p.brake_shares), forces)
    gradients = np.maximum(forces.gradient, 0.0)
    wheels = np.maximum(body.wheels + step * change.wheels / (1 + step * gradients * p.radius / p.wheel_inertia), 0.0)
    added_force = gradients * (wheels - body.wheels)
    speed = np.maximum(body.speed + step * (change.speed + 2 * (added_force[0] + added_force[1]) / p.mass), 0.0)
    is_standing = (body.speed <= 0) & (drive_torque <= 0) & (p.back >= 0)  # Pacejka's tyres push slightly even without slip
    pitch_rate, heave_rate = body.pitch_rate + step * change.pitch_rate, body.heave_rate + step * change.heave_rate
    height_rates = body.height_rates + step * change.height_rates
    return MultiBody(
        speed=np.where(is_standing, 0.0, speed), pitch=body.pitch + step * pitch_rate, pitch_rate=pitch_rate,
        heave=body.heave + step * heave_rate, heave_rate=heave_rate, heights=body.heights + step * height_rates, height_rates=height_rates,
        wheels=wheels, pressure_shares=pressure_shares)


def _anti_lock(body: MultiBody, slip: FloatArray, pedal: FloatArray, step: float) -> FloatArray:
    """The share of full pressure that each axle may have: it falls while the axle's slip is too large, then rises to 1."""
    is_locking = (slip > SLIP_LIMIT) & (body.speed > LEAST_CONTROL_SPEED)
    lower_shares = np.maximum(np.minimum(body.pressure_shares, pedal) - RELEASE * step, 0.0)
    return np.where(is_locking, lower_shares, np.minimum(body.pressure_shares + BUILD_UP * step, 1.0))
