"""One step of vehicle `carla`: the equations of one vehicle, compiled by Numba for many vehicles
side by side.

No operation is fused or reordered: a vehicle gets the same bits as with Python's own floats,
whichever unit of the processor computes it. Numba's cache notices changes of this file only: so
this file defines the records and the constants of the equations, and other numbers are arguments.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray, FloatOrArray
from safevar_sumo.vehicles.compiled import compiled, equation

VEHICLES_SIDE_BY_SIDE = 64
"""Number of vehicles side by side: LLVM computes several at once, and a block stays in the
processor's first cache.
"""
TYRE_STEPS = 3
"""Tyre steps in a substep, at every speed; PhysX's number below 5 m/s (setSubStepCount)."""
NEUTRAL = 0.0
FIRST_GEAR = 1.0
"""The lowest forward gear."""
TOP_GEAR = 4.0
"""The highest forward gear."""
# Torque curve of CARLA's default car: (0, 400), (1890, 500), (5730, 400) in r/min and N m. The
# curve is stretched over max_rpm of the vehicle.
TORQUE_IDLE = 400.0  # N m
TORQUE_PEAK = 500.0  # N m
TORQUE_END = 400.0  # N m
# Engine speeds of peak and end over the maximum engine speed. The falling line extends to 1.
PEAK_SPEED = 1890 / 5800
END_SPEED = 5730 / 5800
TORQUE_RISE = (TORQUE_PEAK - TORQUE_IDLE) / PEAK_SPEED
TORQUE_FALL = (TORQUE_PEAK - TORQUE_END) / (END_SPEED - PEAK_SPEED)
# Neutral first; blueprint of the LincolnMkz2017.
GEAR_RATIOS = 0.0, 2.85, 2.02, 1.35, 1.0
FINAL_RATIO = 4.0
OVERALL_RATIOS = tuple(ratio * FINAL_RATIO for ratio in GEAR_RATIOS)


class Car(NamedTuple):
    """Constants of one vehicle, in SI units. Outside the compiled step: of N vehicles, shape (N,).

    Inertias are divided by the tyre step. In a tyre step the speed changes by `speed_by_force` per
    unit of force, and falls by `speed_by_slope` on a slope. `grip` is the largest tyre force [N]. A
    shift ends after `shift_end` [s]. Below the speed `standstill` [m/s] the tyres hold a braked
    vehicle.
    """

    radius: FloatOrArray
    wheel_inertia: FloatOrArray
    wheel_damping: FloatOrArray
    brake_torque: FloatOrArray
    grip: FloatOrArray
    slip_stiffness: FloatOrArray  # K / (3 |slip|), see `tyre_force`
    clutch: FloatOrArray
    engine_limit: FloatOrArray
    damping_full: FloatOrArray
    damping_engaged: FloatOrArray
    damping_neutral: FloatOrArray
    shift_end: FloatOrArray
    air_drag: FloatOrArray
    speed_by_force: FloatOrArray
    speed_by_slope: FloatOrArray
    standstill: FloatOrArray


class Law(NamedTuple):
    """Parameters that all vehicles share: of pedals, engine, gearbox and tyres, in SI units.

    `throttle_rise` to `brake_fall` are the largest changes of a pedal in a substep [-].
    """

    substep: float
    throttle_rise: float
    throttle_fall: float
    brake_rise: float
    brake_fall: float
    engine_inertia: float
    engine_torque: float
    shift_up: float
    shift_down: float
    shift_latency: float
    slip_offset: float


class CarlaState(NamedTuple):
    """State of one vehicle: its speed [m/s], the speeds of wheels and engine [rad/s], gears [-],
    the time since a shift began [s], and pedals [-]. Outside the compiled step: of N vehicles,
    shape (N,).

    `gear` is neutral during a shift to `target_gear`. `since_shift` is minus infinity while the
    gear is held.
    """

    speed: FloatOrArray
    wheel_speed: FloatOrArray
    engine_speed: FloatOrArray
    gear: FloatOrArray
    target_gear: FloatOrArray
    since_shift: FloatOrArray
    throttle: FloatOrArray
    brake: FloatOrArray


def full_torque(car: Car, law: Law, engine_speed: FloatOrArray) -> FloatOrArray:
    """Engine torque at full throttle [N m]: the lower of two lines over the engine's speed as a
    share of its highest speed.
    """
    speed_share = engine_speed / car.engine_limit
    rising_line = TORQUE_IDLE + TORQUE_RISE * speed_share
    falling_line = TORQUE_PEAK - TORQUE_FALL * (speed_share - PEAK_SPEED)
    return law.engine_torque * np.minimum(rising_line, falling_line)


_full_torque = equation(full_torque)


@equation
def pedal_position(
    command: FloatOrArray, pedal: FloatOrArray, fall: float, rise: float
) -> FloatOrArray:
    """Position of a pedal after a substep: it follows its command, but by no more than the largest
    fall and rise.
    """
    return pedal + np.minimum(np.maximum(command - pedal, -fall), rise)


@equation
def ratio_of(gear: FloatOrArray) -> FloatOrArray:
    """Overall ratio of a gear; 0 in neutral."""
    neutral, first_ratio, second_ratio, third_ratio, fourth_ratio = OVERALL_RATIOS
    low = first_ratio if gear == 1.0 else second_ratio
    high = third_ratio if gear == 3.0 else fourth_ratio
    engaged = low if gear < 3.0 else high
    return engaged if gear > NEUTRAL else neutral


@equation
def shift(
    car: Car, law: Law, s: CarlaState, throttle: FloatOrArray
) -> tuple[FloatOrArray, FloatOrArray, FloatOrArray]:
    """Gear, target gear and time since a shift began, after a substep of the automatic gearbox;
    during a shift the gear is neutral.
    """
    speed_share = s.engine_speed / car.engine_limit
    is_ready = s.since_shift >= law.shift_latency
    sets_off = (s.gear <= NEUTRAL) & (s.gear == s.target_gear) & (throttle > 0.0)
    up = sets_off | (
        is_ready
        & (speed_share > law.shift_up)
        & (s.gear > NEUTRAL)
        & (s.gear < TOP_GEAR)
    )
    down = is_ready & (speed_share < law.shift_down) & (s.gear > FIRST_GEAR)
    target = s.target_gear + (1.0 if up else 0.0) - (1.0 if down else 0.0)
    since_shift = 0.0 if up | down else s.since_shift + law.substep
    gear = target if (target == s.gear) | (since_shift >= car.shift_end) else NEUTRAL
    return gear, target, since_shift


@equation
def tyre_force(
    car: Car, law: Law, speed: FloatOrArray, rim: FloatOrArray
) -> FloatOrArray:
    """Longitudinal force of the tyres [N] (`PxVehicleComputeTireForceDefault` without lateral
    slip).

    With slip = (rim - speed) / (max(rim, speed) + offset) and K = C |slip| / (mu load):
    F = mu load (K - K^2 / 3 + K^3 / 27) = mu load (1 - (1 - K / 3)^3) up to K = 3, mu load beyond.
    """
    slip_speed = rim - speed
    denominator = np.maximum(rim, speed) + law.slip_offset
    # `adhesion` is 1 - K / 3 in the equation: 1 without slip, 0 if the tyre slides.
    adhesion = (
        np.maximum(denominator - car.slip_stiffness * np.abs(slip_speed), 0.0)
        / denominator
    )
    return np.copysign(car.grip - car.grip * adhesion * adhesion * adhesion, slip_speed)


@equation
def roll(
    car: Car,
    law: Law,
    s: CarlaState,
    gear: FloatOrArray,
    throttle: FloatOrArray,
    brake: FloatOrArray,
) -> tuple[FloatOrArray, FloatOrArray, FloatOrArray]:
    """Engine, clutch, wheels, tyres and body over one substep: the speeds of vehicle, wheels and
    engine after it.

    I_e dw_e/dt = throttle T(w_e) - c_e w_e - k_c (w_e - G w_w)
    I_w dw_w/dt = G k_c (w_e - G w_w) - d w_w - T_brake - r F
    m dv/dt = F - D v |v| - m g sin

    Index e is the engine, w the wheels; G is the gear ratio, k_c the clutch strength, c_e and d are
    damping rates, D is the air drag. The tyre force F is explicit. It may end the slip within a
    step but never reverse it, so the slip cannot oscillate.
    """
    ratio = ratio_of(gear)
    clutch = car.clutch if gear > NEUTRAL else 0.0
    damping = car.damping_engaged if gear > NEUTRAL else car.damping_neutral
    clutch_by_ratio = ratio * clutch
    # Inertias with the terms of damping and clutch, which the step solves implicitly:
    engine = (
        law.engine_inertia + damping + (car.damping_full - damping) * throttle + clutch
    )
    wheel = (
        car.wheel_inertia
        + car.wheel_damping
        + clutch_by_ratio * ratio * (1.0 - clutch / engine)
    )
    # Coefficients of a tyre step: x_by_y is the change of x for a unit of y. The speed of the rim
    # [m/s] takes the place of the wheel's speed [rad/s].
    engine_share = law.engine_inertia / engine
    engine_gain = throttle * _full_torque(car, law, s.engine_speed) / engine
    rim_by_torque = car.radius / wheel
    rim_share = car.wheel_inertia / wheel
    rim_by_engine = clutch_by_ratio * rim_by_torque
    rim_loss = brake * car.brake_torque * rim_by_torque
    rim_by_force = car.radius * rim_by_torque
    speed_loss = (
        car.speed_by_force * car.air_drag * s.speed * s.speed + car.speed_by_slope
    )
    slip_by_force = rim_by_force + car.speed_by_force
    engine_by_rim = clutch_by_ratio / (engine * car.radius)

    speed = s.speed
    rim = car.radius * s.wheel_speed
    engine_speed = s.engine_speed
    for _ in range(TYRE_STEPS):
        free_engine_speed = engine_share * engine_speed + engine_gain
        free_rim = rim_share * rim + rim_by_engine * free_engine_speed - rim_loss
        slip_end_force = (free_rim - speed) / slip_by_force
        lower_limit = np.minimum(slip_end_force, 0.0)
        upper_limit = np.maximum(slip_end_force, 0.0)
        force = np.minimum(
            np.maximum(tyre_force(car, law, speed, rim), lower_limit), upper_limit
        )
        rim = np.maximum(free_rim - rim_by_force * force, 0.0)
        engine_speed = np.minimum(
            free_engine_speed + engine_by_rim * rim, car.engine_limit
        )
        speed = np.maximum(speed + car.speed_by_force * force - speed_loss, 0.0)
    return speed, rim / car.radius, engine_speed


@equation
def move(
    car: Car,
    law: Law,
    s: CarlaState,
    throttle_command: FloatOrArray,
    brake_command: FloatOrArray,
) -> CarlaState:
    """The state of a vehicle one substep later."""
    throttle = pedal_position(
        throttle_command, s.throttle, law.throttle_fall, law.throttle_rise
    )
    brake = pedal_position(brake_command, s.brake, law.brake_fall, law.brake_rise)
    gear, target_gear, since_shift = shift(car, law, s, throttle)
    speed, wheel_speed, engine_speed = roll(car, law, s, gear, throttle, brake)
    return CarlaState(
        speed, wheel_speed, engine_speed, gear, target_gear, since_shift, throttle, brake
    )  # fmt: skip


@equation
def car_in(column: FloatArray) -> Car:
    """The vehicle in a column of a block."""
    return Car(
        column[0], column[1], column[2], column[3], column[4], column[5], column[6],
        column[7], column[8], column[9], column[10], column[11], column[12], column[13],
        column[14], column[15],
    )  # fmt: skip


@equation
def state_in(column: FloatArray) -> CarlaState:
    """The state in a column of a block."""
    return CarlaState(
        column[16], column[17], column[18], column[19],
        column[20], column[21], column[22], column[23],
    )  # fmt: skip


@compiled
def advance(
    cars: FloatArray, law: Law, states: FloatArray, commands: FloatArray, substeps: int
) -> None:
    """Move N vehicles by `substeps`; `states` changes in place.

    The rows of `cars`, shape (16, N), are the fields of `Car`. The rows of `states`, shape (8, N),
    are the fields of `CarlaState`. The rows of `commands`, shape (2, N), are throttle and brake.
    """
    n = states.shape[1]
    # A block has 16 rows of `Car`, 8 of `CarlaState` and 2 of commands. Columns without a vehicle
    # are 1, so that no equation divides by 0.
    block = np.ones((26, VEHICLES_SIDE_BY_SIDE))
    for start in range(0, n, VEHICLES_SIDE_BY_SIDE):
        count = min(VEHICLES_SIDE_BY_SIDE, n - start)
        block[:16, :count] = cars[:, start : start + count]
        block[16:24, :count] = states[:, start : start + count]
        block[24:, :count] = commands[:, start : start + count]
        for _ in range(substeps):
            # All columns are computed, even without a vehicle: a fixed number is faster.
            for i in range(VEHICLES_SIDE_BY_SIDE):
                column = block[:, i]
                car = car_in(column)
                s = move(car, law, state_in(column), column[24], column[25])
                column[16] = s.speed
                column[17] = s.wheel_speed
                column[18] = s.engine_speed
                column[19] = s.gear
                column[20] = s.target_gear
                column[21] = s.since_shift
                column[22] = s.throttle
                column[23] = s.brake

        # A braked vehicle stands if it is slower than the speed at which a slope moves its wheels.
        for i in range(count):
            if block[23, i] > 0.0 and block[16, i] < block[15, i]:
                block[16, i] = 0.0
                block[17, i] = 0.0
        states[:, start : start + count] = block[16:24, :count]
