"""CommonRoad's multi-body vehicle with Pacejka's tyres, driving straight, with anti-lock and traction control.

The equations are those of `vehicle_dynamics_mb` of commonroad-vehicle-models (Althoff and Würsching, "CommonRoad:
Vehicle Models", 2020) for a vehicle that neither steers nor rolls: body, pitch and heave, two axles on springs, and the
wheels of each axle. The package computes one vehicle at a time with all 29 states; this module computes the 11 states
that change, for N vehicles at once.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Quantity
from safevar_sumo.vehicles import Slope

WHEEL_COUNT = 4
LONGEST_STEP = 1e-3
"""Longest step of the integration [s]; the phase of the fastest motion, an axle on its springs (75 rad/s), advances by
0.08 rad in a step.
"""
LEAST_SPEED = 0.1
"""Smallest denominator of a slip [m/s]: half of `v_s` in the package's `vehicle_dynamics_std`."""
SLIP_LIMIT, LEAST_CONTROL_SPEED = 0.1, 2.0
"""Slip above which the anti-lock controller releases brake pressure [-], and speed above which it acts [m/s].

Real controllers work between 0.1 and 0.2 from about 7 km/h on (Bosch, Automotive Handbook, "Antilock braking system").
"""
RELEASE_RATE, BUILD_UP_RATE = 25.0, 8.0
"""Rates at which the anti-lock controller releases and restores pressure [1/s], as shares of full pressure; valves
release faster.

Chosen values: braking uses at least 0.78 of the friction, for coefficients from 0.2 to 1 (tests). UN Regulation 13-H,
annex 6, requires 0.75.
"""
TRACTION_SHARE = 0.9
"""Share of the greatest tyre force that the traction control lets the engine use [-]; tyres reach this share at about
half of the slip of their peak.
"""


@cache
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
        raise InputError(
            "opinion",
            "commonroad-vehicle-models, the second vehicle model, is not installed",
            "in the checkout: pip install '.[opinion]'",
        ) from None
    return parameters_vehicle2()


ZERO, ONE, UNLIMITED = map(np.array, (0.0, 1.0, np.inf))


class Plant(NamedTuple):
    """Constants of N vehicles in SI units, shape (N,) or (); comments give their names in the package. Values per axle
    have the shape (2, N) or (2, 1), front before rear.

    The brake pedal follows its command after the dead time `brake_delay`, as a first-order lag with the time constant
    `brake_lag`, at most at the rates `brake_rise` and `brake_fall` [1/s]. `drag` [N s/m], `air_drag` [N s^2/m^2] and
    `wheel_damping` of all wheels [N m s] are resistances in addition to those of the original vehicle. `drive_ratio`
    multiplies the original engine's driving torque.
    """

    mass: FloatArray  # m
    sprung_mass: FloatArray  # m_s
    unsprung_mass: float | FloatArray  # m_uf, of one axle
    arms: FloatArray  # per axle: a and -b
    static_shares: FloatArray  # per axle, of the sprung mass
    height: float | FloatArray  # h_s, plus the body's heave in balance
    pitch_inertia: float | FloatArray  # I_y_s
    springs: FloatArray  # per axle, of one wheel: K_sf and K_sr
    dampers: FloatArray  # per axle, of one wheel: K_sdf and K_sdr
    tyre_spring: float | FloatArray  # K_zt
    brake_shares: FloatArray  # per axle: T_sb and 1 - T_sb
    drive_shares: FloatArray  # per axle: T_se and 1 - T_se
    back: float | FloatArray  # as in `Slope`
    down: float | FloatArray  # as in `Slope`
    radius: FloatArray  # R_w
    wheel_inertia: FloatArray  # I_y_w
    friction: FloatArray  # Pacejka's p_dx1
    brake_torque: FloatArray  # of all wheels at full pedal
    brake_delay: FloatArray = ZERO
    brake_rise: FloatArray = UNLIMITED
    brake_fall: FloatArray = UNLIMITED
    brake_lag: FloatArray = ZERO
    drag: FloatArray = ZERO
    air_drag: FloatArray = ZERO
    wheel_damping: FloatArray = ZERO
    drive_ratio: FloatArray = ONE


def build_plant(
    mass: FloatArray,
    unladen_mass: float,
    slope: Slope,
    *,
    front_brake_share: float = 0.5,
    front_drive_share: float = 0.5,
    centre: FloatArray | None = None,
    wheelbase: float | None = None,
    height: float | None = None,
    **constants: Quantity,
) -> Plant:
    """Scale the package's vehicle to vehicles of other masses [kg].

    Unsprung masses, springs, dampers, tyres and inertia grow with `unladen_mass` [kg], so that all frequencies stay the
    package's; what is loaded rests on the springs. `centre` is the distance from the front axle to the whole vehicle's
    centre of mass [m], `height` its height above the road [m]; the package's values replace None. `constants` are other
    fields of `Plant`.
    """
    bmw = load_bmw_parameters()
    scale = unladen_mass / bmw.m
    package_length = bmw.a + bmw.b
    length = wheelbase or package_length
    unsprung_mass = scale * bmw.m_uf
    sprung_mass = mass - 2 * unsprung_mass
    front_arm = (bmw.a / package_length) * length * np.ones_like(mass)
    if centre is not None:
        front_arm = (mass * centre - unsprung_mass * length) / sprung_mass

    def per_axle(front: float, rear: float) -> FloatArray:
        return np.array([[front], [rear]])

    plant = Plant(
        mass=mass,
        sprung_mass=sprung_mass,
        unsprung_mass=unsprung_mass,
        arms=np.stack([front_arm, front_arm - length]),
        static_shares=np.stack([length - front_arm, front_arm]) / length,
        height=height or bmw.h_s,
        pitch_inertia=scale * bmw.I_y_s * (length / package_length) ** 2,
        tyre_spring=scale * bmw.K_zt,
        springs=scale * per_axle(bmw.K_sf, bmw.K_sr),
        dampers=scale * per_axle(bmw.K_sdf, bmw.K_sdr),
        brake_shares=per_axle(front_brake_share, 1 - front_brake_share),
        back=slope.back,
        down=slope.down,
        drive_shares=per_axle(front_drive_share, 1 - front_drive_share),
        **constants,
    )
    # Heave counts from unloaded tyres: with this sum, the height that is left in balance, at any speed, is h_s.
    return plant._replace(height=plant.height + balanced_state(plant, np.zeros_like(mass)).heights[0])


class MultiBodyState(NamedTuple):
    """State of N vehicles, SI.

    `speed` has the shape (N,). `heights`, shape (4, N), are the body's heave and pitch, and the heights of front and
    rear axle; `rates` are their derivatives. Heights count downwards, as in the package. For each axle, shape (2, N):
    the speed of its wheels [rad/s], and the share of full pressure that the anti-lock controller allows.
    """

    speed: FloatArray
    heights: FloatArray
    rates: FloatArray
    wheel_speeds: FloatArray
    pressure_shares: FloatArray


def balanced_state(plant: Plant, speed: FloatArray) -> MultiBodyState:
    """The body in static balance on its springs, with rolling wheels."""
    axle_loads = (plant.sprung_mass * plant.static_shares + plant.unsprung_mass) * plant.down
    axle_heights = axle_loads / (2 * plant.tyre_spring)
    # The length of a spring counts from that under its static load: in balance, the body is as high as each axle below.
    heave = (axle_heights * plant.static_shares).sum(axis=0)
    pitch = (axle_heights[1] - axle_heights[0]) / (plant.arms[0] - plant.arms[1])
    heights = np.stack([heave, pitch, *axle_heights])
    ones = np.ones_like(axle_heights)
    return MultiBodyState(speed, heights, np.zeros_like(heights), ones * speed / plant.radius, ones)


class TyreForces(NamedTuple):
    """Of one tyre of each axle, shape (2, N): the force along the road and its greatest value [N], the slip [-],
    positive when braking, and the derivative of the force by the wheel's speed [N s/rad].
    """

    force: FloatArray
    peak: FloatArray
    slip: FloatArray
    by_wheel_speed: FloatArray


def tyre_forces(plant: Plant, body: MultiBodyState) -> TyreForces:
    """Pacejka's formula for pure longitudinal slip, as in the package's `formula_longitudinal`, and its derivative."""
    tyre = load_bmw_parameters().tire
    slip_denominator = np.maximum(body.speed, LEAST_SPEED)
    load = np.maximum(body.heights[2:] * plant.tyre_spring, 1.0)
    slip = (body.speed - plant.radius * body.wheel_speeds) / slip_denominator
    peak = plant.friction * load
    stiffness = tyre.p_kx1 / (tyre.p_cx1 * plant.friction)
    scaled_slip = stiffness * (tyre.p_hx1 - slip)
    curve = (1 - tyre.p_ex1) * scaled_slip + tyre.p_ex1 * np.arctan(scaled_slip)
    angle = tyre.p_cx1 * np.arctan(curve) + load * tyre.p_vx1
    bend = 1 - tyre.p_ex1 + tyre.p_ex1 / (1 + scaled_slip * scaled_slip)
    force_by_scaled_slip = peak * np.cos(angle) * (tyre.p_cx1 / (1 + curve * curve)) * bend
    by_wheel_speed = force_by_scaled_slip * (stiffness * plant.radius / slip_denominator)
    return TyreForces(peak * np.sin(angle), peak, slip, by_wheel_speed)


class Accelerations(NamedTuple):
    """Derivatives of a `MultiBodyState`: of speed, shape (N,), rates, (4, N), and wheel speeds, (2, N)."""

    speed: FloatArray
    rates: FloatArray
    wheel_speeds: FloatArray


def derivatives(plant: Plant, body: MultiBodyState, torques: FloatArray, force: FloatArray) -> Accelerations:
    """The right-hand side of the package's equations.

    `torques`, shape (2, N), turn both wheels of an axle forward [N m]; `force` is that of one tyre of each axle [N].
    """
    traction = 2 * (force[0] + force[1])
    deflection, deflection_rate = (
        coordinates[2:] - coordinates[0] + plant.arms * coordinates[1] for coordinates in (body.heights, body.rates)
    )
    static_loads = plant.sprung_mass * plant.down * plant.static_shares / 2
    spring_forces = static_loads - deflection * plant.springs - deflection_rate * plant.dampers
    moments = plant.arms * spring_forces
    heave_acceleration = plant.down - 2 * (spring_forces[0] + spring_forces[1]) / plant.sprung_mass
    pitch_moment = 2 * (moments[0] + moments[1]) + traction * (plant.height - body.heights[0])
    pitch_acceleration = pitch_moment / plant.pitch_inertia
    axle_accelerations = plant.down - 2 * (body.heights[2:] * plant.tyre_spring - spring_forces) / plant.unsprung_mass
    return Accelerations(
        speed=traction / plant.mass - plant.back,
        rates=np.stack([heave_acceleration, pitch_acceleration, *axle_accelerations]),
        wheel_speeds=(torques / 2 - plant.radius * force) / plant.wheel_inertia,
    )


def advance(
    plant: Plant, body: MultiBodyState, pedal: FloatArray, drive_torque: FloatArray, step: float
) -> MultiBodyState:
    """One integration step under a brake pedal (0 to 1) and a torque of engine and drags on all wheels [N m].

    Wheel speeds, which are stiff, are integrated implicitly (linearised), others explicitly, rates before heights.
    """
    tyres = tyre_forces(plant, body)
    is_locking = (tyres.slip > SLIP_LIMIT) & (body.speed > LEAST_CONTROL_SPEED)
    lower_shares = np.maximum(np.minimum(body.pressure_shares, pedal) - RELEASE_RATE * step, 0.0)
    pressure_shares = np.where(is_locking, lower_shares, np.minimum(body.pressure_shares + BUILD_UP_RATE * step, 1.0))
    drive = np.minimum(drive_torque * plant.drive_shares, 2 * TRACTION_SHARE * plant.radius * tyres.peak)
    brakes = np.minimum(pedal, pressure_shares) * (plant.brake_torque * plant.brake_shares)
    accelerations = derivatives(plant, body, drive - brakes, tyres.force)
    gradients = np.maximum(tyres.by_wheel_speed, 0.0)  # 0 beyond the peak of the tyre's force
    damping = 1 + step * gradients * plant.radius / plant.wheel_inertia
    wheel_speeds = np.maximum(body.wheel_speeds + step * accelerations.wheel_speeds / damping, 0.0)
    added_force = gradients * (wheel_speeds - body.wheel_speeds)
    acceleration = accelerations.speed + 2 * (added_force[0] + added_force[1]) / plant.mass
    speed = np.maximum(body.speed + step * acceleration, 0.0)
    # Pacejka's tyres push slightly even without slip, so a vehicle without drive is held.
    is_standing = (body.speed <= 0) & (drive_torque <= 0) & (plant.back >= 0)
    speed = np.where(is_standing, 0.0, speed)
    rates = body.rates + step * accelerations.rates
    return MultiBodyState(speed, body.heights + step * rates, rates, wheel_speeds, pressure_shares)
