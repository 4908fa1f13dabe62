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
"""Speed that a slip is relative to at the least [m/s]: half of `v_s` in the package's `vehicle_dynamics_std`."""
SLIP, LEAST_CONTROLLED = 0.1, 2.0
"""Slip above which the anti-lock controller takes brake pressure away [-], and the speed from which on it acts [m/s].

Real ones work between 0.1 and 0.2 from about 7 km/h on (Bosch, Automotive Handbook, "Antilock braking system").
"""
RELEASE, BUILD_UP = 25.0, 8.0
"""Rates at which it takes pressure away and lets it rise again [1/s], as shares of full pressure: faster down than up, as valves are.

Chosen; they use at least 0.78 of the friction from 0.2 to 1 (tests), of which UN Regulation 13-H, annex 6, asks for 0.75.
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
        raise InputError("opinion", "needs commonroad-vehicle-models, which is not installed",
                         "pip install 'safevar_sumo[opinion]'") from None
    return _parameters(parameters_vehicle2)


@cache
def _parameters(read: Any) -> Any:
    return read()


class Plant(NamedTuple):
    """Constants of N vehicles, SI, shape (N,), named after the package's: m, m_s, m_uf, a, b, h_s, I_y_s, K_sf, K_sdf, ...

    `friction` is Pacejka's p_dx1. `brake_torque` is that of all wheels at full pedal, `brake_front` and `drive_front` the shares T_sb and
    T_se of the front axle.
    """

    mass: FloatArray
    sprung: FloatArray
    unsprung: FloatArray
    front: FloatArray
    rear: FloatArray
    height: FloatArray
    pitch_inertia: FloatArray
    springs: tuple[FloatArray, FloatArray]
    dampers: tuple[FloatArray, FloatArray]
    tyre_spring: FloatArray
    radius: FloatArray
    wheel_inertia: FloatArray
    friction: FloatArray
    brake_torque: FloatArray
    brake_front: FloatArray
    drive_front: FloatArray
    back: FloatArray
    down: FloatArray


def plant_of(mass: FloatArray, empty: float, centre: FloatArray | None, wheelbase: float | None, height: float | None, slope: Slope,
             **others: Any) -> Plant:
    """A vehicle of another mass than the package's.

    Unsprung masses, springs, dampers, tyres and inertia grow with the `empty` vehicle's mass, so that all frequencies stay the package's;
    what is loaded rests on the springs. `centre` is the whole vehicle's behind the front axle [m]; what is None is the package's.
    """
    p = commonroad()
    ones, scale = np.ones_like(mass), empty / p.m
    unsprung = scale * p.m_uf * ones
    sprung, length = mass - 2 * unsprung, p.a + p.b if wheelbase is None else wheelbase
    front = (p.a / (p.a + p.b)) * length * ones if centre is None else (mass * centre - unsprung * length) / sprung
    values = {name: np.asarray(value, dtype=float) * ones for name, value in others.items()}
    plant = Plant(
        mass=mass, sprung=sprung, unsprung=unsprung, front=front, rear=length - front, height=(p.h_s if height is None else height) * ones,
        pitch_inertia=scale * p.I_y_s * ones * (length / (p.a + p.b)) ** 2, springs=(scale * p.K_sf * ones, scale * p.K_sr * ones),
        dampers=(scale * p.K_sdf * ones, scale * p.K_sdr * ones), tyre_spring=scale * p.K_zt * ones, back=slope.back * ones,
        down=slope.down * ones, **values)
    return plant._replace(height=plant.height + at_speed(plant, ones).heave)  # the body's own is counted from unloaded tyres


class Body(NamedTuple):
    """State of N vehicles, shape (N,), SI: speed; pitch and heave of the body, and their rates; of the axles height, rate and wheel
    speed, front and rear; and the share of the full pressure that the anti-lock controller allows each axle.

    Heights count downwards, as in the package.
    """

    speed: FloatArray
    pitch: FloatArray
    pitch_rate: FloatArray
    heave: FloatArray
    heave_rate: FloatArray
    heights: tuple[FloatArray, FloatArray]
    height_rates: tuple[FloatArray, FloatArray]
    wheels: tuple[FloatArray, FloatArray]
    allowed: tuple[FloatArray, FloatArray]


def at_speed(plant: Plant, speed: FloatArray) -> Body:
    """At rest on its springs, wheels rolling."""
    nothing, length = np.zeros_like(plant.mass), plant.front + plant.rear
    loads = (plant.sprung * plant.rear / length + plant.unsprung, plant.sprung * plant.front / length + plant.unsprung)
    heights = (loads[0] * plant.down / (2 * plant.tyre_spring), loads[1] * plant.down / (2 * plant.tyre_spring))
    # The springs carry their loads unbent where body and axles are level: the body stands where its axles do.
    heave = (heights[0] * plant.rear + heights[1] * plant.front) / length
    pitch = (heights[1] - heights[0]) / length
    one = nothing + 1
    return Body(speed, pitch, nothing, heave, nothing, heights, (nothing, nothing), (speed / plant.radius,) * 2, (one, one))


class Forces(NamedTuple):
    """Along the road for one tyre of the front and of the rear axle [N], how they grow with the wheel's speed [N s/rad], and its slip
    [-], positive where it brakes.
    """

    force: tuple[FloatArray, FloatArray]
    growth: tuple[FloatArray, FloatArray]
    slip: tuple[FloatArray, FloatArray]


def tyre_forces(plant: Plant, body: Body) -> Forces:
    """Pacejka's formula for pure longitudinal slip, as the package's `formula_longitudinal` has it, and its derivative."""
    tyre, relative_to = commonroad().tire, np.maximum(body.speed, LEAST_SPEED)
    forces, growths, slips = [], [], []
    for height, wheel in zip(body.heights, body.wheels, strict=True):
        load = np.maximum(height * plant.tyre_spring, 1.0)
        slip = (body.speed - plant.radius * wheel) / relative_to
        largest = plant.friction * load
        steep = tyre.p_kx1 / (tyre.p_cx1 * plant.friction)
        bent = steep * (tyre.p_hx1 - slip)
        turned = (1 - tyre.p_ex1) * bent + tyre.p_ex1 * np.arctan(bent)
        angle = tyre.p_cx1 * np.arctan(turned) + load * tyre.p_vx1
        by_slip = (largest * np.cos(angle) * tyre.p_cx1 / (1 + turned * turned)
                   * steep * (1 - tyre.p_ex1 + tyre.p_ex1 / (1 + bent * bent)))
        forces.append(largest * np.sin(angle))
        growths.append(by_slip * plant.radius / relative_to)
        slips.append(slip)
    return Forces(tuple(forces), tuple(growths), tuple(slips))  # type: ignore[arg-type]


class Rates(NamedTuple):
    """Rates of change of the rates in a body, SI, shape (N,)."""

    speed: FloatArray
    pitch_rate: FloatArray
    heave_rate: FloatArray
    height_rates: tuple[FloatArray, FloatArray]
    wheels: tuple[FloatArray, FloatArray]


def rates(plant: Plant, body: Body, torques: tuple[FloatArray, FloatArray], forces: Forces) -> Rates:
    """The package's right-hand side; `torques` turn both wheels of the front and of the rear axle forward [N m]."""
    p, (front, rear) = plant, forces.force
    length, along = p.front + p.rear, 2 * (front + rear)
    springs = []
    for k, (arm, other) in enumerate(((p.front, p.rear), (-p.rear, p.front))):
        bend = body.heights[k] - body.heave + arm * body.pitch
        bend_rate = body.height_rates[k] - body.heave_rate + arm * body.pitch_rate
        springs.append(p.sprung * p.down * other / (2 * length) - bend * p.springs[k] - bend_rate * p.dampers[k])
    axles = [p.down - 2 * (height * p.tyre_spring - spring) / p.unsprung for height, spring in zip(body.heights, springs, strict=True)]
    wheels = [(torque / 2 - p.radius * force) / p.wheel_inertia for torque, force in zip(torques, forces.force, strict=True)]
    return Rates(
        speed=along / p.mass - p.back,
        pitch_rate=(2 * (p.front * springs[0] - p.rear * springs[1]) + along * (p.height - body.heave)) / p.pitch_inertia,
        heave_rate=p.down - 2 * (springs[0] + springs[1]) / p.sprung, height_rates=(axles[0], axles[1]), wheels=(wheels[0], wheels[1]))


def advance(plant: Plant, body: Body, pedal: FloatArray, driving: FloatArray, step: float) -> Body:
    """A step of the integration under a brake pedal and a torque of engine and drags on all wheels [N m].

    Wheels, which are stiff, go implicitly, linearised; the others rate first, height after.
    """
    p, forces = plant, tyre_forces(plant, body)
    shares = ((p.brake_front, p.drive_front), (1 - p.brake_front, 1 - p.drive_front))
    allowed = [_anti_lock(body, forces.slip[k], body.allowed[k], pedal, step) for k in range(2)]
    torques = [driving * drive - np.minimum(pedal, allowed[k]) * p.brake_torque * brake for k, (brake, drive) in enumerate(shares)]
    change = rates(plant, body, (torques[0], torques[1]), forces)
    wheels, along = [], change.speed
    for k in range(2):
        stiff = np.maximum(forces.growth[k], 0.0)
        wheel = np.maximum(body.wheels[k] + step * change.wheels[k] / (1 + step * stiff * p.radius / p.wheel_inertia), 0.0)
        along = along + 2 * stiff * (wheel - body.wheels[k]) / p.mass
        wheels.append(wheel)
    pitch_rate, heave_rate = body.pitch_rate + step * change.pitch_rate, body.heave_rate + step * change.heave_rate
    height_rates = tuple(before + step * by for before, by in zip(body.height_rates, change.height_rates, strict=True))
    stands = (body.speed <= 0) & (driving <= 0) & (p.back >= 0)  # tyres of Pacejka's push a little where they do not slip at all
    speed = np.where(stands, 0.0, np.maximum(body.speed + step * along, 0.0))
    return Body(
        speed=speed, pitch=body.pitch + step * pitch_rate, pitch_rate=pitch_rate, heave=body.heave + step * heave_rate,
        heave_rate=heave_rate,
        heights=tuple(before + step * by for before, by in zip(body.heights, height_rates, strict=True)),  # type: ignore[arg-type]
        height_rates=height_rates, wheels=(wheels[0], wheels[1]), allowed=(allowed[0], allowed[1]))  # type: ignore[arg-type]


def _anti_lock(body: Body, slip: FloatArray, allowed: FloatArray, pedal: FloatArray, step: float) -> FloatArray:
    """The share of full pressure that an axle may have: less while its slip is too large, then more again, up to any pedal."""
    locks = (slip > SLIP) & (body.speed > LEAST_CONTROLLED)
    less = np.maximum(np.minimum(allowed, pedal) - RELEASE * step, 0.0)
    return np.where(locks, less, np.minimum(allowed + BUILD_UP * step, 1.0))
