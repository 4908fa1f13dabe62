"""CommonRoad's multi-body vehicle with Pacejka's tyres, driving straight, with an anti-lock controller.

The equations are those of `vehicle_dynamics_mb` of commonroad-vehicle-models (Althoff and Würsching, "CommonRoad: Vehicle Models", 2020)
for a vehicle that neither steers nor rolls: body, pitch and heave, two axles on springs, and the wheels of each axle. The package computes
one vehicle at a time with all 29 states; here the 11 that move are computed for N vehicles at once.
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
"""Longest step of the integration [s]: a sixth of a radian of the fastest motion, an axle between its springs and its tyres (75 rad/s)."""
LEAST_SPEED = 0.1
"""Slip is relative to the speed, but at least to this one [m/s]: half of `v_s` in the package's `vehicle_dynamics_std`."""
SLIP, LEAST_CONTROLLED = 0.1, 2.0
"""Slip above which the anti-lock controller releases brake pressure [-], and the speed above which it acts [m/s].

Real controllers work between 0.1 and 0.2 from about 7 km/h on (Bosch, Automotive Handbook, "Antilock braking system").
"""
RELEASE, BUILD_UP = 25.0, 8.0
"""Rates at which the controller releases and restores pressure [1/s], as shares of full pressure; valves release faster than they restore.

Chosen; they use at least 0.78 of a friction from 0.2 to 1 (tests), where UN Regulation 13-H, annex 6, requires 0.75.
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
def _parameters(read: Any) -> Any:
    return read()


@cache
def _tyre() -> Any:
    return commonroad().tire


class Plant(NamedTuple):
    """Constants of N vehicles, SI, after the package's m, m_s, m_uf, m_ur, a, b, h_s, I_y_s, K_sf, K_sdf, K_zt, R_w, I_y_w.

    Shape (N,), or (2, N) for values per axle, front before rear: `arms`, a and -b; `static`, shares of the sprung mass; `springs` and
    `dampers` of each wheel; `brake_shares`, T_sb and 1 - T_sb; `drive_shares`, T_se and 1 - T_se. `unsprung` is an axle's mass,
    `friction` Pacejka's p_dx1, `brake_torque` the torque of all wheels at full pedal; `back` and `down` are the slope's.
    """

    mass: FloatArray
    sprung: FloatArray
    unsprung: FloatArray
    arms: FloatArray
    static: FloatArray
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


def plant_of(mass: FloatArray, empty: float, slope: Slope, *, brake_front: float, drive_front: float, centre: FloatArray | None = None,
             wheelbase: float | None = None, height: float | None = None, **others: Any) -> Plant:
    """A vehicle with another mass than the package's.

    Unsprung masses, springs, dampers, tyres and inertia grow with the `empty` vehicle's mass, so that all frequencies stay the package's;
    a load rests on the springs. `centre` is the whole vehicle's centre of mass behind the front axle [m], `height` that above the road
    [m]; the package's values replace None.
    """
    p = commonroad()
    ones, scale = np.ones_like(mass), empty / p.m
    unsprung = scale * p.m_uf * ones
    sprung, length = mass - 2 * unsprung, p.a + p.b if wheelbase is None else wheelbase
    front = (p.a / (p.a + p.b)) * length * ones if centre is None else (mass * centre - unsprung * length) / sprung
    values = {name: np.asarray(value, dtype=float) * ones for name, value in others.items()}
    plant = Plant(
        mass=mass, sprung=sprung, unsprung=unsprung, arms=np.stack([front, front - length]),
        static=np.stack([length - front, front]) / length, height=(p.h_s if height is None else height) * ones,
        pitch_inertia=scale * p.I_y_s * ones * (length / (p.a + p.b)) ** 2, springs=scale * np.stack([p.K_sf * ones, p.K_sr * ones]),
        dampers=scale * np.stack([p.K_sdf * ones, p.K_sdr * ones]), tyre_spring=scale * p.K_zt * ones,
        brake_shares=np.stack([brake_front * ones, (1 - brake_front) * ones]),
        drive_shares=np.stack([drive_front * ones, (1 - drive_front) * ones]), back=slope.back * ones, down=slope.down * ones, **values)
    return plant._replace(height=plant.height + at_speed(plant, ones).heave)  # the body's heights count from unloaded tyres


class MultiBody(NamedTuple):
    """State of N vehicles, SI: speed, pitch and heave of the body with their rates, shape (N,); of the axles, front before rear, height,
    its rate and the wheels' speed, and the share of full pressure that the anti-lock controller allows, shape (2, N).

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
    allowed: FloatArray


def at_speed(plant: Plant, speed: FloatArray) -> MultiBody:
    """The body in static balance on its springs, with rolling wheels."""
    zeros, axle_zeros = np.zeros_like(plant.mass), np.zeros_like(plant.arms)
    heights = (plant.sprung * plant.static + plant.unsprung) * plant.down / (2 * plant.tyre_spring)
    # The springs carry the static load without deflection if, above each axle, the body is as high as the axle.
    heave, pitch = (heights * plant.static).sum(axis=0), (heights[1] - heights[0]) / (plant.arms[0] - plant.arms[1])
    return MultiBody(speed, pitch, zeros, heave, zeros, heights, axle_zeros, axle_zeros + speed / plant.radius, axle_zeros + 1)


class Forces(NamedTuple):
    """One tyre of each axle, shape (2, N): the force along the road [N], its derivative by the wheel's speed [N s/rad], and the slip [-],
    positive when braking.
    """

    force: FloatArray
    growth: FloatArray
    slip: FloatArray


def tyre_forces(plant: Plant, body: MultiBody) -> Forces:
    """Pacejka's formula for pure longitudinal slip, as in the package's `formula_longitudinal`, and its derivative."""
    tyre, relative_to = _tyre(), np.maximum(body.speed, LEAST_SPEED)
    load = np.maximum(body.heights * plant.tyre_spring, 1.0)
    slip = (body.speed - plant.radius * body.wheels) / relative_to
    largest, steep = plant.friction * load, tyre.p_kx1 / (tyre.p_cx1 * plant.friction)
    bent = steep * (tyre.p_hx1 - slip)
    turned = (1 - tyre.p_ex1) * bent + tyre.p_ex1 * np.arctan(bent)
    angle = tyre.p_cx1 * np.arctan(turned) + load * tyre.p_vx1
    by_bend = largest * np.cos(angle) * (tyre.p_cx1 / (1 + turned * turned)) * (1 - tyre.p_ex1 + tyre.p_ex1 / (1 + bent * bent))
    return Forces(largest * np.sin(angle), by_bend * (steep * plant.radius / relative_to), slip)


class Rates(NamedTuple):
    """Time derivatives of a body's speed, rates and wheel speeds, SI; shapes as in `MultiBody`."""

    speed: FloatArray
    pitch_rate: FloatArray
    heave_rate: FloatArray
    height_rates: FloatArray
    wheels: FloatArray


def rates(plant: Plant, body: MultiBody, torques: FloatArray, forces: Forces) -> Rates:
    """The package's right-hand side; `torques`, shape (2, N), turn both wheels of an axle forward [N m]."""
    p, along = plant, 2 * (forces.force[0] + forces.force[1])
    bend = body.heights - body.heave + p.arms * body.pitch
    bend_rate = body.height_rates - body.heave_rate + p.arms * body.pitch_rate
    springs = p.sprung * p.down * p.static / 2 - bend * p.springs - bend_rate * p.dampers
    levered = p.arms * springs
    return Rates(
        speed=along / p.mass - p.back,
        pitch_rate=(2 * (levered[0] + levered[1]) + along * (p.height - body.heave)) / p.pitch_inertia,
        heave_rate=p.down - 2 * (springs[0] + springs[1]) / p.sprung,
        height_rates=p.down - 2 * (body.heights * p.tyre_spring - springs) / p.unsprung,
        wheels=(torques / 2 - p.radius * forces.force) / p.wheel_inertia)


def advance(plant: Plant, body: MultiBody, pedal: FloatArray, driving: FloatArray, step: float) -> MultiBody:
    """A step of the integration under a brake pedal and a torque of engine and drags on all wheels [N m].

    Wheel speeds, which are stiff, are integrated implicitly (linearised); all others explicitly, rates before heights.
    """
    p, forces = plant, tyre_forces(plant, body)
    allowed = _anti_lock(body, forces.slip, pedal, step)
    change = rates(p, body, driving * p.drive_shares - np.minimum(pedal, allowed) * (p.brake_torque * p.brake_shares), forces)
    stiff = np.maximum(forces.growth, 0.0)
    wheels = np.maximum(body.wheels + step * change.wheels / (1 + step * stiff * p.radius / p.wheel_inertia), 0.0)
    gained = stiff * (wheels - body.wheels)
    speed = np.maximum(body.speed + step * (change.speed + 2 * (gained[0] + gained[1]) / p.mass), 0.0)
    stands = (body.speed <= 0) & (driving <= 0) & (p.back >= 0)  # Pacejka's tyres push a little even without any slip
    pitch_rate, heave_rate = body.pitch_rate + step * change.pitch_rate, body.heave_rate + step * change.heave_rate
    height_rates = body.height_rates + step * change.height_rates
    return MultiBody(
        speed=np.where(stands, 0.0, speed), pitch=body.pitch + step * pitch_rate, pitch_rate=pitch_rate,
        heave=body.heave + step * heave_rate, heave_rate=heave_rate, heights=body.heights + step * height_rates, height_rates=height_rates,
        wheels=wheels, allowed=allowed)


def _anti_lock(body: MultiBody, slip: FloatArray, pedal: FloatArray, step: float) -> FloatArray:
    """The share of full pressure that each axle may have: less while its slip is too large, then more again, up to any pedal."""
    locks = (slip > SLIP) & (body.speed > LEAST_CONTROLLED)
    less = np.maximum(np.minimum(body.allowed, pedal) - RELEASE * step, 0.0)
    return np.where(locks, less, np.minimum(body.allowed + BUILD_UP * step, 1.0))
