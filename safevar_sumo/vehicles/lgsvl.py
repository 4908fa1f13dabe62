"""Lincoln2017MKZ of LGSVL 2021.1: VehicleSMI on Unity's WheelColliders, along its path.

The equations come from the simulator's `VehicleSMI.cs` and from the friction of Unity's
WheelCollider. One equivalent wheel represents the four. In a substep, wheel and body form one
linear system with the secant stiffness of the tyre. Its implicit solution has a closed form.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.records import (
    Command,
    FloatArray,
    FloatOrArray,
    Observation,
    clip_to_share,
)
from safevar_sumo.study import Proportion
from safevar_sumo.vehicles.base import (
    LEVEL,
    MASS,
    SECONDS,
    WHEELS,
    Characteristics,
    Plausible,
    Slope,
    SumoType,
    Vehicle,
)

RPM_PER_RAD_S = 30 / math.pi  # r/min per rad/s
RADIANS = math.pi / 180  # rad per degree
LGSVL_GEAR_RATIOS = np.array(
    [4.17, 3.14, 2.11, 1.67, 1.28, 1.0, 0.84, 0.67]
)  # VehicleSMI
LGSVL_FIRST_GEAR = 1.0
LAST_GEAR = float(len(LGSVL_GEAR_RATIOS))
LGSVL_FINAL_RATIO = 2.56  # VehicleSMI
SHIFT_DELAY = 0.7  # s, minimum time between two shifts; VehicleSMI
# Engine speeds above and below which the gearbox shifts, over maxRpm (assumption).
SHIFT_UP = 0.33
SHIFT_DOWN = 0.13
# 1/s: the engine speed follows the wheels with a time constant of 1/20 s; VehicleSMI.
RPM_RATE = 20.0
# Share of maxMotorTorque that the traction control allows at the start; VehicleSMI.
TRACTION_START = 1 - 0.675
# N m/s, rate at which the allowed torque rises and falls; VehicleSMI, at 50 Hz.
TRACTION_RATE = 6.75 / 0.02
AIR_DRAG = 1.0  # N s^2/m^2; VehicleSMI
DOWNFORCE = 2.0  # N s^2/m^2; VehicleSMI
# Forward friction of Unity's WheelCollider over slip: it rises to an extremum at PEAK_SLIP, and
# falls to an asymptote, SLIDING_FRICTION of the extremum, at SLIDING_SLIP.
PEAK_SLIP = 0.4
SLIDING_SLIP = 0.8
SLIDING_FRICTION = 0.5
SLIDING_RANGE = SLIDING_SLIP - PEAK_SLIP
FRICTION_LOSS = 1 - SLIDING_FRICTION
LGSVL_FRICTION = 1.0  # at the extremum
# m/s, smallest speed by which a slip speed is divided (assumption, as in PhysX).
SLIP_FLOOR = 4.0
# m/s, smallest rim speed with which the slip limit of the traction control is multiplied.
LEAST_RIM_SPEED = 1e-3
# m/s, below which locked wheels hold the vehicle (assumption).
LGSVL_HOLD_SPEED = 0.05
LGSVL_WHEELBASE = 2.85  # m
# Errors at the start that the lane keeping corrects (assumption): without them the steering angle
# would have no effect.
LATERAL_ERROR = 0.10  # m
HEADING_ERROR = 0.01  # rad
LATERAL_GAIN = 0.02  # rad/m
HEADING_GAIN = 0.35  # rad/rad
# Torques over maxMotorTorque (assumption).
LGSVL_TORQUE_IDLE = 0.4
TORQUE_BEND = 2.4
SUBSTEPS = 2


class _Prepared(NamedTuple):
    """Constants of N vehicles in a run, shape (N,) or (), in SI units; engine speeds are in r/min.

    `body` is the mass that the tyres accelerate: the vehicle, with a share of the wheels' mass.
    `steering` is the full steering angle [rad]. Below the speed `standstill` locked wheels hold the
    vehicle.
    """

    step: float
    substep: float
    mass: FloatArray
    weight: FloatArray  # load on the road [N]
    body: FloatArray
    slope_deceleration: FloatOrArray  # by the slope, g sin(angle) [m/s^2]
    standstill: FloatOrArray
    radius: FloatArray
    inertia: FloatArray
    damping: FloatArray
    brake_torque: FloatArray
    motor_torque: FloatArray
    least_rpm: FloatArray
    largest_rpm: FloatArray
    steering: FloatArray
    rolling_drag: FloatArray
    shift_time: FloatArray
    slip_limit: FloatArray
    friction: FloatOrArray


class LgsvlState(NamedTuple):
    """State of N vehicles: speeds of vehicle [m/s], wheels [rad/s] and engine [r/min]; gear and
    gear ratios [-]; time since the last shift [s]; torque that the traction control allows [N m];
    lateral position [m]; heading [rad]; pedals [-].
    """

    speed: FloatArray
    wheel_speed: FloatArray
    engine_rpm: FloatArray
    gear: FloatArray
    old_ratio: FloatArray
    new_ratio: FloatArray
    since_shift: FloatArray
    traction_torque: FloatArray
    lateral: FloatArray
    heading: FloatArray
    throttle: FloatArray
    brake: FloatArray


class Lgsvl(Vehicle, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle of the study `lgsvl`.

    Parameters
    ----------
    pedal_lag
        Time constant with which pedals follow their commands [s].
    wheel_mass_share
        Share of the four wheels' mass that is added to the mass of the body [-].
    wheel_damping_share
        Share of wheelDamping that acts on a rolling wheel [-]; the published data show little
        damping.
    steering_design_angle
        maxSteeringAngle of the vehicle for which the lane keeping was designed [deg].
    """

    UNITS = {
        "mass": "kg",
        "wheelMass": "kg",
        "radius": "m",
        "maxRpm": "r/min",
        "minRpm": "r/min",
        "maxBrakeTorque": "N m",
        "maxMotorTorque": "N m",
        "maxSteeringAngle": "deg",
        "tireDragCoeff": "-",
        "wheelDamping": "kg m^2/s",
        "shiftTime": "s",
        "tractionControlSlipLimit": "-",
    }
    PLAUSIBLE = {
        "mass": MASS,
        "wheelMass": Plausible(1, 500),
        "radius": Plausible(0.1, 1),
        "maxRpm": Plausible(300, 30_000),
        "minRpm": Plausible(50, 5000),
        "maxBrakeTorque": Plausible(20, 50_000),
        "maxMotorTorque": Plausible(5, 10_000),
        "maxSteeringAngle": Plausible(5, 90),
        "tireDragCoeff": Plausible(0.001, 100),
        "wheelDamping": Plausible(0.001, 50),
        "shiftTime": SECONDS,
        "tractionControlSlipLimit": Plausible(0.01, 2),
        "steering_design_angle": Plausible(5, 90, "deg"),
    }

    pedal_lag: Annotated[float, Meta(ge=0)]
    wheel_mass_share: Proportion
    wheel_damping_share: Proportion
    steering_design_angle: Annotated[float, Meta(gt=0, lt=90)] = 39.4

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        water: FloatOrArray = 0.0,
    ) -> _Prepared:
        c = characteristics
        inertia = WHEELS * 0.5 * c["wheelMass"] * c["radius"] * c["radius"]
        prepared = _Prepared(
            step=step,
            substep=step / SUBSTEPS,
            mass=c["mass"],
            weight=c["mass"] * slope.down,
            body=c["mass"] + self.wheel_mass_share * WHEELS * c["wheelMass"],
            slope_deceleration=slope.back,
            standstill=LGSVL_HOLD_SPEED,
            radius=c["radius"],
            inertia=inertia,
            damping=WHEELS * self.wheel_damping_share * c["wheelDamping"],
            brake_torque=WHEELS * c["maxBrakeTorque"],
            motor_torque=c["maxMotorTorque"],
            least_rpm=c["minRpm"],
            largest_rpm=c["maxRpm"],
            steering=c["maxSteeringAngle"] * RADIANS,
            rolling_drag=c["tireDragCoeff"],
            shift_time=c["shiftTime"],
            slip_limit=c["tractionControlSlipLimit"],
            friction=LGSVL_FRICTION * road_friction,
        )

        # On a slope even locked wheels creep, with the slip whose tyre force balances the slope:
        # this speed counts as standstill, too.
        creep_speed = _rim_at(
            prepared,
            np.zeros_like(prepared.mass),
            np.abs(prepared.body * prepared.slope_deceleration),
        )
        return prepared._replace(standstill=LGSVL_HOLD_SPEED + creep_speed)

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        p = prepared
        grip = p.friction * p.weight
        drive = p.motor_torque * (LGSVL_GEAR_RATIOS[0] * LGSVL_FINAL_RATIO) / p.radius
        return SumoType(
            mass=p.mass,
            accel=np.minimum(drive, grip) / p.mass,
            decel=np.minimum(p.brake_torque / p.radius, grip) / p.mass,
            max_speed=p.largest_rpm
            / RPM_PER_RAD_S
            / (LGSVL_GEAR_RATIOS[-1] * LGSVL_FINAL_RATIO)
            * p.radius,
            actuator_lag=np.full_like(p.mass, p.step + self.pedal_lag),
        )

    def at_rest(self, prepared: _Prepared) -> LgsvlState:
        zeros = np.zeros_like(prepared.mass)
        first_ratio = zeros + LGSVL_GEAR_RATIOS[0]
        return LgsvlState(
            speed=zeros,
            wheel_speed=zeros,
            engine_rpm=prepared.least_rpm,
            gear=zeros + 1,
            old_ratio=first_ratio,
            new_ratio=first_ratio,
            since_shift=zeros + SHIFT_DELAY,
            traction_torque=TRACTION_START * prepared.motor_torque,
            lateral=zeros + LATERAL_ERROR,
            heading=zeros + HEADING_ERROR,
            throttle=zeros,
            brake=zeros,
        )

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> LgsvlState:
        """The steady state at a speed: in every equation the rate of change is 0.

        The vehicle keeps its lane without error. The gearbox has shifted up to the gear for this
        speed.
        """
        p = prepared
        zeros = np.zeros_like(prepared.mass)

        force = (
            AIR_DRAG * speed + p.rolling_drag
        ) * speed + p.body * p.slope_deceleration
        wheel_speed = _rim_at(p, speed, force) / p.radius

        gear = zeros + 1
        for lower_ratio in LGSVL_GEAR_RATIOS[:-1]:
            rpm = p.least_rpm + wheel_speed * (
                lower_ratio * LGSVL_FINAL_RATIO * RPM_PER_RAD_S
            )
            gear += rpm > SHIFT_UP * p.largest_rpm
        ratio = LGSVL_GEAR_RATIOS[gear.astype(np.intp) - 1]
        gearing = ratio * LGSVL_FINAL_RATIO

        engine_rpm = p.least_rpm + wheel_speed * gearing * RPM_PER_RAD_S
        full_torque = (
            _torque_share(engine_rpm / p.largest_rpm) * gearing * p.motor_torque
        )
        needed_torque = p.damping * wheel_speed + p.radius * force
        throttle = clip_to_share(needed_torque / np.maximum(full_torque, 1.0))
        brake = clip_to_share(-needed_torque / p.brake_torque)
        return self.at_rest(p)._replace(
            speed=speed,
            wheel_speed=wheel_speed,
            engine_rpm=engine_rpm,
            gear=gear,
            old_ratio=ratio,
            new_ratio=ratio,
            traction_torque=p.motor_torque,
            lateral=zeros,
            heading=zeros,
            throttle=throttle,
            brake=brake,
        )

    def sense(
        self, prepared: _Prepared, state: LgsvlState, observation: Observation
    ) -> tuple[Observation, LgsvlState]:
        return observation, state

    def advance(
        self, prepared: _Prepared, state: LgsvlState, command: Command
    ) -> LgsvlState:
        p = prepared
        lateral, heading, cornering_drag = self._steer(p, state)
        # Share of its distance from the command by which a pedal moves in a step.
        pedal_share = p.step / (p.step + self.pedal_lag)
        state = _shift(p, state)._replace(
            throttle=state.throttle + (command.throttle - state.throttle) * pedal_share,
            brake=state.brake + (command.brake - state.brake) * pedal_share,
            lateral=lateral,
            heading=heading,
        )

        gearing = _ratio(p, state) * LGSVL_FINAL_RATIO
        for _ in range(SUBSTEPS):
            state = _roll(p, state, gearing, cornering_drag)
        return state._replace(since_shift=state.since_shift + p.step)

    def _steer(
        self, p: _Prepared, s: LgsvlState
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Lateral position [m], heading [rad] and cornering drag [N s/m] after a step of the lane
        keeping; the vehicle is a kinematic bicycle at small angles.

        The lane keeping commands a share of the full steering angle. Its gains were designed for a
        vehicle with the full angle `steering_design_angle`.
        """
        share = -(LATERAL_GAIN * s.lateral + HEADING_GAIN * s.heading) / (
            self.steering_design_angle * RADIANS
        )
        angle = np.minimum(np.maximum(share, -1.0), 1.0) * p.steering
        curvature = angle / LGSVL_WHEELBASE
        heading = s.heading + s.speed * curvature * p.step
        lateral = s.lateral + s.speed * p.step * 0.5 * (s.heading + heading)
        # The lateral force is m v^2 curvature. Its share `angle` points back; divided by v, it is a
        # drag coefficient.
        return lateral, heading, p.mass * np.abs(curvature * angle) * s.speed


def _shift(p: _Prepared, s: LgsvlState) -> LgsvlState:
    """The state after the decision of the automatic gearbox, which depends on the engine speed. For
    shiftTime after a shift, the ratio changes linearly from the old gear's to the new gear's.
    """
    rpm_share = s.engine_rpm / p.largest_rpm
    is_ready = s.since_shift >= SHIFT_DELAY
    up = is_ready & (rpm_share > SHIFT_UP) & (s.gear < LAST_GEAR)
    down = is_ready & (rpm_share < SHIFT_DOWN) & (s.gear > LGSVL_FIRST_GEAR)
    shifts = up | down
    if not np.count_nonzero(shifts):
        return s
    gear = s.gear + up - down
    return s._replace(
        gear=gear,
        old_ratio=np.where(shifts, _ratio(p, s), s.old_ratio),
        new_ratio=np.where(
            shifts, LGSVL_GEAR_RATIOS[gear.astype(np.intp) - 1], s.new_ratio
        ),
        since_shift=np.where(shifts, 0.0, s.since_shift),
    )


def _ratio(p: _Prepared, s: LgsvlState) -> FloatArray:
    """The current gear ratio [-]; see `_shift`."""
    return np.asarray(
        s.old_ratio
        + (s.new_ratio - s.old_ratio) * np.minimum(s.since_shift / p.shift_time, 1.0)
    )


def _roll(
    p: _Prepared, s: LgsvlState, gearing: FloatArray, cornering_drag: FloatArray
) -> LgsvlState:
    """One implicit Euler step of engine speed, wheel and body, linear in the new speeds; the
    wheel's equation is solved with the body's speed eliminated.

    I dw/dt = T_drive - T_brake - d w - r K (r w - v)
    m dv/dt = K (r w - v) - (D_air v + D_tyre + D_corner) v - m g sin

    With h for the substep, M = m + h (K + D_air v + D_tyre + D_corner) (`damped_mass`), p = h r K
    (`pull`) and u = v - h g sin (`slope_speed`), the new speeds w' and v' are

    w' (I + h d + p r - p^2 / M) = I w + h (T_drive - T_brake) + p m u / M    (`wheel_momentum`)
    v' = (m u + p w') / M
    """
    h = p.substep
    steady_rpm = p.least_rpm + s.wheel_speed * gearing * RPM_PER_RAD_S
    engine_rpm = s.engine_rpm + (steady_rpm - s.engine_rpm) * (
        RPM_RATE * h / (1 + RPM_RATE * h)
    )
    drive = (
        _torque_share(engine_rpm / p.largest_rpm)
        * gearing
        * s.traction_torque
        * s.throttle
    )

    rim = p.radius * s.wheel_speed
    slip_speed = rim - s.speed
    is_spinning = slip_speed > p.slip_limit * np.maximum(rim, LEAST_RIM_SPEED)
    torque_change = TRACTION_RATE * h
    traction_torque = s.traction_torque + np.where(
        is_spinning, -torque_change, torque_change
    )

    stiffness = _tyre_stiffness(p, s.speed, rim, slip_speed)
    pull = h * p.radius * stiffness
    damped_mass = p.body + h * (
        stiffness + AIR_DRAG * s.speed + p.rolling_drag + cornering_drag
    )
    slope_speed = s.speed - p.slope_deceleration * h
    wheel_momentum = (
        p.inertia * s.wheel_speed
        + h * (drive - s.brake * p.brake_torque)
        + pull * p.body * slope_speed / damped_mass
    )
    wheel_speed = np.maximum(wheel_momentum, 0.0) / (
        p.inertia + h * p.damping + pull * p.radius - pull * pull / damped_mass
    )
    speed = np.maximum((p.body * slope_speed + pull * wheel_speed) / damped_mass, 0.0)

    # A vehicle with locked wheels stands if it is slower than `standstill`.
    speed[(wheel_speed <= 0.0) & (speed < p.standstill)] = 0.0
    return s._replace(
        speed=speed,
        wheel_speed=wheel_speed,
        engine_rpm=engine_rpm,
        traction_torque=np.minimum(np.maximum(traction_torque, 0.0), p.motor_torque),
    )


def _torque_share(rpm_share: FloatArray) -> FloatArray:
    """Engine torque over maxMotorTorque, from the engine speed over maxRpm: a parabola up to
    maxRpm, and 0 from maxRpm on (assumption).
    """
    torque_share = LGSVL_TORQUE_IDLE + TORQUE_BEND * rpm_share * (1.0 - rpm_share)
    torque_share[rpm_share >= 1.0] = 0.0
    return torque_share


def _rim_at(p: _Prepared, speed: FloatArray, force: FloatArray) -> FloatArray:
    """Rim speed [m/s] at which the tyre force is `force` [N]: the solution of the rising part of
    the curve in `_tyre_stiffness` for the rim speed.
    """
    grip_share = np.minimum(
        np.abs(force) / (p.friction * (p.weight + DOWNFORCE * speed * speed)), 1.0
    )
    # From grip_share = x (2 - x) with x = slip / PEAK_SLIP.
    slip = PEAK_SLIP * grip_share / (1 + np.sqrt(1 - grip_share))
    slow_rim = speed + SLIP_FLOOR * slip
    driving_rim = np.where(slow_rim <= SLIP_FLOOR, slow_rim, speed / (1 - slip))
    braking_rim = speed - np.maximum(speed, SLIP_FLOOR) * slip
    return np.asarray(np.where(force < 0, braking_rim, driving_rim))


def _tyre_stiffness(
    p: _Prepared, speed: FloatArray, rim: FloatArray, slip_speed: FloatArray
) -> FloatArray:
    """Secant stiffness of the tyre [N s/m]: tyre force over slip speed. The force over slip is that
    of Unity's WheelCollider: a parabola to the extremum, then a line to the asymptote.
    """
    denominator = np.maximum(np.maximum(speed, rim), SLIP_FLOOR)
    slip = np.abs(slip_speed) / denominator
    friction_by_slip = (2.0 - slip / PEAK_SLIP) / PEAK_SLIP
    is_sliding = slip >= PEAK_SLIP
    if np.count_nonzero(is_sliding):
        sliding_share = np.minimum((slip - PEAK_SLIP) / SLIDING_RANGE, 1.0)
        sliding = (1.0 - FRICTION_LOSS * sliding_share) / np.maximum(slip, PEAK_SLIP)
        friction_by_slip = np.where(is_sliding, sliding, friction_by_slip)
    load = p.weight + DOWNFORCE * speed * speed
    return np.asarray(p.friction * load * friction_by_slip / denominator)
