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

WHEEL_COUNT = 4
LONGEST_STEP = 1e-3
"""Longest step of the integration [s]; in it the fastest motion, an axle between springs and tyres (75 rad/s), turns by 0.08 rad."""
LEAST_SPEED = 0.1
"""Smallest denominator of a slip [m/s]: half of `v_s` in the package's `vehicle_dynamics_std`."""
SLIP_LIMIT, LEAST_CONTROL_SPEED = 0.1, 2.0
"""Slip above which the anti-lock controller releases brake pressure [-], and speed above which the controller acts [m/s].

Real controllers work between 0.1 and 0.2 from about 7 km/h on (Bosch, Automotive Handbook, "Antilock braking system").
"""
TRACTION_SHARE = 0.9
RELEASE_RATE, BUILD_UP_RATE = 25.0, 8.0
"""Rates at which the controller releases and restores pressure [1/s], as shares of full pressure; valves release faster than they restore.

Chosen values: braking uses at least 0.78 of the friction, for coefficients from 0.2 to 1 (tests). UN Regulation 13-H, annex 6, requires
0.75.
"""


def load_bmw_parameters() -> Any:
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
                         "in the checkout: pip install '.[opinion]'") from None
    return _parameters(parameters_vehicle2)


@cache
def _parameters(load_parameters: Any) -> Any:
    return load_parameters()


@cache
def _tyre() -> Any:
    return load_bmw_parameters().tire


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


def build_plant(mass: FloatArray, unladen_mass: float, slope: Slope, *, front_brake_share: float, front_drive_share: float,
                centre: FloatArray | None = None, wheelbase: float | None = None, height: float | None = None, **constants: Any) -> Plant:
    """Vehicles with masses [kg] that differ from the package's vehicle.

    Unsprung masses, springs, dampers, tyres and inertia grow with `unladen_mass` [kg], so that all frequencies stay the package's;
    a load rests on the springs. `centre` is the distance from the front axle to the whole vehicle's centre of mass [m], `height` the
    height of that centre above the road [m]; the package's values replace None.
    """
    bmw = load_bmw_parameters()
    ones, scale = np.ones_like(mass), unladen_mass / bmw.m
    unsprung_mass = scale * bmw.m_uf * ones
    sprung_mass, length = mass - 2 * unsprung_mass, bmw.a + bmw.b if wheelbase is None else wheelbase
    front_arm = (bmw.a / (bmw.a + bmw.b)) * length * ones if centre is None else (mass * centre - unsprung_mass * length) / sprung_mass
    values = {name: np.asarray(value, dtype=float) * ones for name, value in constants.items()}
    plant = Plant(
        mass=mass, sprung_mass=sprung_mass, unsprung_mass=unsprung_mass, arms=np.stack([front_arm, front_arm - length]),
        static_shares=np.stack([length - front_arm, front_arm]) / length, height=(bmw.h_s if height is None else height) * ones,
        pitch_inertia=scale * bmw.I_y_s * ones * (length / (bmw.a + bmw.b)) ** 2, tyre_spring=scale * bmw.K_zt * ones,
        springs=scale * np.stack([bmw.K_sf * ones, bmw.K_sr * ones]), dampers=scale * np.stack([bmw.K_sdf * ones, bmw.K_sdr * ones]),
        brake_shares=np.stack([front_brake_share * ones, (1 - front_brake_share) * ones]),
        drive_shares=np.stack([front_drive_share * ones, (1 - front_drive_share) * ones]),
        back=slope.back * ones, down=slope.down * ones, **values)
    return plant._replace(height=plant.height + at_speed(plant, ones).heave)  # the body's heights count from unloaded tyres


class MultiBodyState(NamedTuple):
    """State of N vehicles, SI: speed, pitch and heave of the body, and the rates of pitch and heave, shape (N,).

    The other fields hold a value for each axle, front before rear, shape (2, N): its height and the height's rate, its wheels' speed
    [rad/s], and the share of full pressure that the anti-lock controller allows. Heights count downwards, as in the package.
    """

    speed: FloatArray
    pitch: FloatArray
    pitch_rate: FloatArray
    heave: FloatArray
    heave_rate: FloatArray
    axle_heights: FloatArray
    axle_rates: FloatArray
    wheel_speeds: FloatArray
    pressure_shares: FloatArray


def at_speed(plant: Plant, speed: FloatArray) -> MultiBodyState:
    """The body in static balance on its springs, with rolling wheels."""
    zeros, axle_zeros = np.zeros_like(plant.mass), np.zeros_like(plant.arms)
    heights = (plant.sprung_mass * plant.static_shares + plant.unsprung_mass) * plant.down / (2 * plant.tyre_spring)
    # The springs carry the static load without deflection if, above each axle, the body is as high as the axle.
    heave, pitch = (heights * plant.static_shares).sum(axis=0), (heights[1] - heights[0]) / (plant.arms[0] - plant.arms[1])
    return MultiBodyState(speed, pitch, zeros, heave, zeros, heights, axle_zeros, axle_zeros + speed / plant.radius, axle_zeros + 1)


class TyreForces(NamedTuple):
    """One tyre of each axle, shape (2, N): the force along the road and its largest value `peak` [N], the force's derivative
    `gradient` by the wheel's speed [N s/rad], and the slip [-], positive when braking.
    """

    force: FloatArray
    peak: FloatArray
    gradient: FloatArray
    slip: FloatArray


def tyre_forces(plant: Plant, body: MultiBodyState) -> TyreForces:
    """Pacejka's formula for pure longitudinal slip, as in the package's `formula_longitudinal`, and its derivative."""
    tyre, slip_speed = _tyre(), np.maximum(body.speed, LEAST_SPEED)
    load = np.maximum(body.axle_heights * plant.tyre_spring, 1.0)
    slip = (body.speed - plant.radius * body.wheel_speeds) / slip_speed
    peak, stiffness = plant.friction * load, tyre.p_kx1 / (tyre.p_cx1 * plant.friction)
    scaled_slip = stiffness * (tyre.p_hx1 - slip)
    curve = (1 - tyre.p_ex1) * scaled_slip + tyre.p_ex1 * np.arctan(scaled_slip)
    angle = tyre.p_cx1 * np.arctan(curve) + load * tyre.p_vx1
    slope = peak * np.cos(angle) * (tyre.p_cx1 / (1 + curve * curve)) * (1 - tyre.p_ex1 + tyre.p_ex1 / (1 + scaled_slip * scaled_slip))
    return TyreForces(peak * np.sin(angle), peak, slope * (stiffness * plant.radius / slip_speed), slip)


class BodyDerivatives(NamedTuple):
    """Time derivatives of the fields of `MultiBodyState` with the same names, SI."""

    speed: FloatArray
    pitch_rate: FloatArray
    heave_rate: FloatArray
    axle_rates: FloatArray
    wheel_speeds: FloatArray


def body_derivatives(plant: Plant, body: MultiBodyState, torques: FloatArray, forces: TyreForces) -> BodyDerivatives:
    """The right-hand side of the package's equations; `torques`, shape (2, N), turn both wheels of an axle forward [N m]."""
    traction = 2 * (forces.force[0] + forces.force[1])
    deflection = body.axle_heights - body.heave + plant.arms * body.pitch
    deflection_rate = body.axle_rates - body.heave_rate + plant.arms * body.pitch_rate
    static_loads = plant.sprung_mass * plant.down * plant.static_shares / 2
    spring_forces = static_loads - deflection * plant.springs - deflection_rate * plant.dampers
    moments = plant.arms * spring_forces
    return BodyDerivatives(
        speed=traction / plant.mass - plant.back,
        pitch_rate=(2 * (moments[0] + moments[1]) + traction * (plant.height - body.heave)) / plant.pitch_inertia,
        heave_rate=plant.down - 2 * (spring_forces[0] + spring_forces[1]) / plant.sprung_mass,
        axle_rates=plant.down - 2 * (body.axle_heights * plant.tyre_spring - spring_forces) / plant.unsprung_mass,
        wheel_speeds=(torques / 2 - plant.radius * forces.force) / plant.wheel_inertia)


def advance(plant: Plant, body: MultiBodyState, pedal: FloatArray, drive_torque: FloatArray, step: float) -> MultiBodyState:
    """One integration step under a brake pedal (0 to 1) and a torque of engine and drags on all wheels [N m].

    Wheel speeds, which are stiff, are integrated implicitly (linearised), all other states explicitly, rates before heights.
    """
    forces = tyre_forces(plant, body)
    pressure_shares = _limit_pressure(body, forces.slip, pedal, step)
    brake_torques = np.minimum(pedal, pressure_shares) * (plant.brake_torque * plant.brake_shares)
    drive_torques = np.minimum(drive_torque * plant.drive_shares, 2 * TRACTION_SHARE * plant.radius * forces.peak)
    derivatives = body_derivatives(plant, body, drive_torques - brake_torques, forces)
    gradients = np.maximum(forces.gradient, 0.0)
    damping = 1 + step * gradients * plant.radius / plant.wheel_inertia
    wheel_speeds = np.maximum(body.wheel_speeds + step * derivatives.wheel_speeds / damping, 0.0)
    added_force = gradients * (wheel_speeds - body.wheel_speeds)
    speed = np.maximum(body.speed + step * (derivatives.speed + 2 * (added_force[0] + added_force[1]) / plant.mass), 0.0)
    is_standing = (body.speed <= 0) & (drive_torque <= 0) & (plant.back >= 0)  # Pacejka's tyres push slightly even without slip
    pitch_rate, heave_rate = body.pitch_rate + step * derivatives.pitch_rate, body.heave_rate + step * derivatives.heave_rate
    axle_rates = body.axle_rates + step * derivatives.axle_rates
    return MultiBodyState(
        speed=np.where(is_standing, 0.0, speed), pitch=body.pitch + step * pitch_rate, pitch_rate=pitch_rate,
        heave=body.heave + step * heave_rate, heave_rate=heave_rate, axle_heights=body.axle_heights + step * axle_rates,
        axle_rates=axle_rates, wheel_speeds=wheel_speeds, pressure_shares=pressure_shares)


def _limit_pressure(body: MultiBodyState, slip: FloatArray, pedal: FloatArray, step: float) -> FloatArray:
    """The share of full pressure that each axle may have: it falls while the axle's slip is too large, then rises to 1."""
    is_locking = (slip > SLIP_LIMIT) & (body.speed > LEAST_CONTROL_SPEED)
    lower_shares = np.maximum(np.minimum(body.pressure_shares, pedal) - RELEASE_RATE * step, 0.0)
    return np.where(is_locking, lower_shares, np.minimum(body.pressure_shares + BUILD_UP_RATE * step, 1.0))
