"""LincolnMkz2017 of CARLA 0.9.10: NVIDIA PhysX 3.4, PxVehicleDrive4W, along its path.

The equations and the order of integration come from `PxVehicleUpdate.cpp` and `PxVehicleDefaultTireShader` (PhysX 3.4).
One equivalent wheel represents the four. A step computes the tyre force from the slip at its beginning, then engine,
clutch and wheels implicitly and in closed form, so that the stiff clutch does not limit the step.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.records import GRAVITY, TIME_ROUNDING, BoolArray, Command, FloatArray, Observation
from safevar_sumo.vehicles.base import LEVEL, Characteristics, Positive, Sensors, Slope, SumoType, Vehicle

Share = Annotated[float, Meta(gt=0, le=1)]
# Constants used with arrays in every step are arrays themselves: numpy would convert a float each time, which doubles
# the cost.
ZERO, ONE = map(np.array, (0.0, 1.0))
NEUTRAL, FIRST_GEAR = ZERO, ONE
RPM = 2 * math.pi / 60  # rad/s per r/min
ENGINE_INERTIA = 1.0  # kg m^2; PxVehicleEngineData.mMOI, CARLA's default
# Torque curve of CARLA's default car: (0, 400), (1890, 500), (5730, 400) r/min, N m, stretched over max_rpm.
TORQUE_IDLE, TORQUE_PEAK, TORQUE_END = map(np.array, (400.0, 500.0, 400.0))  # N m
# Relative to the maximum engine speed; the falling line extends to 1.
PEAK_SPEED, END_SPEED = map(np.array, (1890 / 5800, 5730 / 5800))
TORQUE_RISE = np.array((TORQUE_PEAK - TORQUE_IDLE) / PEAK_SPEED)
TORQUE_FALL = np.array((TORQUE_PEAK - TORQUE_END) / (END_SPEED - PEAK_SPEED))
GEAR_RATIOS = np.array([0.0, 2.85, 2.02, 1.35, 1.0])  # neutral first; blueprint of the LincolnMkz2017
FINAL_RATIO = 4.0
OVERALL_RATIOS = GEAR_RATIOS * FINAL_RATIO
TOP_GEAR = np.array(len(GEAR_RATIOS) - 1.0)
WHEELS = 4
WHEEL_MASS = 20.0  # kg each; PxVehicleWheelData.mMass
AIR_DENSITY = 1.2  # kg/m^3
FRONTAL_AREA = 2.2  # m^2, of the LincolnMkz2017
HOLD_SPEED = np.array(0.03)  # m/s; below this speed the tyres hold a braked vehicle (PxVehicle sticky tires)
SUBSTEP = 1 / 60  # s, the longest substep; CARLA 0.9.10 (MaxSubstepDeltaTime)
NEWTON_STEPS = 8  # from 1 to a cube root near 1; the last steps change nothing
TYRE_STEPS = 3  # per substep, at every speed; PhysX's number below 5 m/s (setSubStepCount)


class _Prepared(NamedTuple):
    """Constants of a run, SI; arrays of shape (N,).

    Inertias are divided by the tyre step, in which the speed changes by `speed_by_force` per unit of force; the slope
    pulls with `pull` [N] and reduces it by `speed_by_slope`. Below the speed `standstill` the tyres hold a braked
    vehicle. `grip` is the largest tyre force [N], `assumed_height` the camera's assumed height over its actual height
    [-].
    """

    substeps: int
    step: float
    mass: FloatArray
    radius: FloatArray
    engine_inertia: FloatArray
    wheel_inertia: FloatArray
    wheel_damping: FloatArray
    brake_torque: FloatArray
    grip: FloatArray
    slip_stiffness: FloatArray  # K / (3 |slip|)
    clutch: FloatArray
    engine_limit: FloatArray
    damping_full: FloatArray
    damping_engaged: FloatArray
    damping_neutral: FloatArray
    shift_time: FloatArray
    air_drag: FloatArray
    speed_by_force: FloatArray
    pull: FloatArray
    speed_by_slope: FloatArray
    assumed_height: FloatArray
    standstill: FloatArray


class CarlaState(NamedTuple):
    """N vehicles: speed [m/s], wheel and engine speeds [rad/s], gears [-], time since a shift began [s], pedals [-].

    `gear` is neutral during a shift to `target_gear`. `since_shift` is minus infinity while the gear is held.
    """

    speed: FloatArray
    wheel_speed: FloatArray
    engine_speed: FloatArray
    gear: FloatArray
    target_gear: FloatArray
    since_shift: FloatArray
    throttle: FloatArray
    brake: FloatArray


def _driveline(p: _Prepared, gear: FloatArray) -> tuple[FloatArray, ...]:
    """Coefficients that depend on the gears, for `Carla._roll`.

    They are the clutch's strength, this strength times the ratio, and times the ratio squared; the engine's inertia
    over a tyre step plus its damping without throttle; and its further damping by full throttle.
    """
    in_gear, ratio = gear > NEUTRAL, OVERALL_RATIOS[gear.astype(np.intp)]
    clutch, damping = p.clutch * in_gear, np.where(in_gear, p.damping_engaged, p.damping_neutral)
    by_ratio = ratio * clutch
    return clutch, by_ratio, by_ratio * ratio, p.engine_inertia + damping, p.damping_full - damping


class Carla(Vehicle, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle of the studies sun and rain.

    Parameters
    ----------
    tyre_friction
        Friction coefficient of a tyre on a dry road per unit of tireFric [-].
    longitudinal_stiffness
        Longitudinal stiffness of a tyre, over gravity [N s^2/m per unit slip]
        (PxVehicleTireData.mLongitudinalStiffnessPerUnitGravity).
    slip_offset
        Speed added to the denominator of a slip [m/s] (0.1 in PxVehicle's `computeTireSlips`).
    engine_torque
        Engine torque relative to that of CARLA's default car [-].
    throttle_rise, throttle_fall, brake_rise, brake_fall
        Rates of the pedals [1/s] (PxVehiclePadSmoothingData: 6 up, 10 down).
    shift_up, shift_down
        Engine speeds over max_rpm above and below which the gearbox shifts [-] (PxVehicleAutoBoxData: 0.65 and 0.5).
    shift_latency
        Minimum time between the beginnings of two shifts [s] (PxVehicleAutoBoxData: 2).
    camera_height, camera_design_radius
        Height of the camera above the road [m] with wheels of the design radius [m]. Wheels of another radius change
        the height, and measured gaps scale by the assumed height over the actual height.
    """

    UNITS = {
        "max_rpm": "r/min",
        "dampRateFullT": "kg m^2/s",
        "dampRateZeroT_CE": "kg m^2/s",
        "dampRateZeroT_CD": "kg m^2/s",
        "gearSwitchTime": "s",
        "clutchStrength": "kg m^2/s",
        "mass": "kg",
        "dragCoeff": "-",
        "tireFric": "-",
        "dampRate": "kg m^2/s",
        "radius": "cm",
        "maxBrakeTorque": "N m",
    }
    FITTED_UP_TO: ClassVar[float] = 6.5  # m/s; highest speed in simulations of the published settings of sun and rain

    tyre_friction: Positive
    longitudinal_stiffness: Positive
    slip_offset: Positive
    engine_torque: Positive
    throttle_rise: Positive = 6.0
    throttle_fall: Positive = 10.0
    brake_rise: Positive = 6.0
    brake_fall: Positive = 10.0
    shift_up: Share = 0.65
    shift_down: Share = 0.5
    shift_latency: Positive = 2.0
    camera_height: Annotated[float, Meta(ge=0.1, le=10)]
    camera_design_radius: Annotated[float, Meta(ge=0.1, le=1)] = 0.355

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        water: float | FloatArray = 0.0,
    ) -> _Prepared:
        c = characteristics
        radius = c["radius"] / 100
        grip = c["tireFric"] * (self.tyre_friction * road_friction) * c["mass"] * slope.down
        substeps = math.ceil(step / SUBSTEP - TIME_ROUNDING)
        substep = step / substeps
        tyre_step = substep / TYRE_STEPS
        prepared = _Prepared(
            substeps=substeps,
            step=substep,
            mass=c["mass"],
            radius=radius,
            engine_inertia=np.array(ENGINE_INERTIA / tyre_step),
            wheel_inertia=WHEELS * 0.5 * WHEEL_MASS * radius * radius / tyre_step,
            wheel_damping=WHEELS * c["dampRate"],
            brake_torque=WHEELS * c["maxBrakeTorque"],
            grip=grip,
            slip_stiffness=WHEELS * GRAVITY * self.longitudinal_stiffness / (3 * grip),
            clutch=c["clutchStrength"],
            engine_limit=c["max_rpm"] * RPM,
            damping_full=c["dampRateFullT"],
            damping_engaged=c["dampRateZeroT_CE"],
            damping_neutral=c["dampRateZeroT_CD"],
            shift_time=c["gearSwitchTime"],
            air_drag=0.5 * AIR_DENSITY * FRONTAL_AREA * c["dragCoeff"],
            speed_by_force=tyre_step / c["mass"],
            pull=c["mass"] * slope.back,
            speed_by_slope=np.zeros_like(radius) + slope.back * tyre_step,
            assumed_height=self.camera_height / (self.camera_height + (radius - self.camera_design_radius)),
            standstill=HOLD_SPEED,
        )
        creep_speed, _ = self._rim_at(prepared._replace(pull=np.abs(prepared.pull)), np.zeros_like(radius))
        return prepared._replace(standstill=HOLD_SPEED + creep_speed)

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        p = prepared
        drive = self.engine_torque * TORQUE_PEAK * OVERALL_RATIOS[1] / p.radius
        return SumoType(
            mass=p.mass,
            accel=np.minimum(drive, p.grip) / p.mass,
            decel=np.minimum(p.brake_torque / p.radius, p.grip) / p.mass,
            max_speed=p.engine_limit / OVERALL_RATIOS[-1] * p.radius,
            actuator_lag=np.full_like(p.mass, p.step * p.substeps + 1 / self.brake_rise),
        )

    def at_rest(self, prepared: _Prepared) -> CarlaState:
        zeros = np.zeros_like(prepared.mass)
        return CarlaState(*(zeros for _ in CarlaState._fields))

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> CarlaState:
        """The steady state, with the pedals that hold the speed: in every equation of `_roll` the rate of change is 0.

        The gearbox has shifted up to the gear for this speed. Where it would now shift down, its last shift has just
        ended, so that it must wait.
        """
        p = prepared
        rim, force = self._rim_at(p, speed)
        wheel_speed = rim / p.radius
        resistance = p.wheel_damping * wheel_speed + p.radius * force

        def engine_in(ratio: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Torque through the clutch and torque that remains for the brake [N m], and engine speed [rad/s]."""
            # Downhill the engine brakes and the brake supplies the rest; then w_e = G w_w + m / k_c with the clutch
            # torque m = -c_e w_e.
            engine_drag = -p.damping_engaged * ratio * wheel_speed / (1 + p.damping_engaged / p.clutch)
            clutch_torque = np.maximum(resistance / ratio, engine_drag)
            engine_speed = np.minimum(ratio * wheel_speed + clutch_torque / p.clutch, p.engine_limit)
            return clutch_torque, ratio * (engine_drag - resistance / ratio), engine_speed

        gear = np.ones_like(p.mass)
        for ratio in OVERALL_RATIOS[1:-1]:
            _, _, engine_speed = engine_in(ratio)
            gear += engine_speed > self.shift_up * p.engine_limit
        clutch_torque, brake_torque, engine_speed = engine_in(OVERALL_RATIOS[gear.astype(np.intp)])
        brake = np.minimum(np.maximum(brake_torque / p.brake_torque, 0.0), 1.0)
        throttle_torque = self._torque(p, engine_speed) - (p.damping_full - p.damping_engaged) * engine_speed
        throttle = (p.damping_engaged * engine_speed + clutch_torque) / np.maximum(throttle_torque, 1.0)
        throttle = np.where(brake > 0, 0.0, np.minimum(throttle, 1.0))
        shifts_down = (gear > 1) & (engine_speed < self.shift_down * p.engine_limit)
        since_shift = np.where(shifts_down, p.shift_time, self.shift_latency)
        return CarlaState(speed, wheel_speed, engine_speed, gear, gear, since_shift, throttle, brake)

    def hold_gear(self, prepared: _Prepared, state: CarlaState, holds: BoolArray) -> CarlaState:
        """Hold the gear where `holds`, shape (N,), is true, as a selector lever does. It may change as soon as it is
        released.
        """
        since_shift = np.where(state.since_shift < 0, self.shift_latency, state.since_shift)
        return state._replace(since_shift=np.where(holds, -np.inf, since_shift))

    def _rim_at(self, p: _Prepared, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rim speed at which the tyre force balances air drag and slope [m/s], and that force [N]."""
        force = np.minimum(np.maximum(p.air_drag * speed * speed + p.pull, -p.grip), p.grip)
        grip_share = np.abs(force) / p.grip
        root = np.ones_like(speed)
        for _ in range(NEWTON_STEPS):  # root^3 = 1 - force / grip; see `_tyre_force`
            root = root - (root * root * root - 1 + grip_share) / (3 * root * root)
        driving_rim = (p.slip_stiffness * speed + self.slip_offset * (1 - root)) / (p.slip_stiffness - 1 + root)
        braking_rim = speed - (speed + self.slip_offset) * (1 - root) / p.slip_stiffness
        return np.where(force < 0, braking_rim, driving_rim), force

    def sensors(self, prepared: _Prepared) -> Sensors:
        return Sensors.perfect(len(prepared.mass))._replace(scale=prepared.assumed_height)

    def sense(self, prepared: _Prepared, state: CarlaState, seen: Observation) -> tuple[Observation, CarlaState]:
        """The gap as the camera measures it: the wheel radius sets the height of the camera."""
        return seen._replace(gap=seen.gap * prepared.assumed_height), state

    def advance(self, prepared: _Prepared, state: CarlaState, command: Command) -> CarlaState:
        p, s, driveline = prepared, state, None
        for _ in range(p.substeps):
            throttle = _pedal_position(
                command.throttle, s.throttle, self.throttle_fall * p.step, self.throttle_rise * p.step
            )
            brake = _pedal_position(command.brake, s.brake, self.brake_fall * p.step, self.brake_rise * p.step)
            gear, target, since_shift = self._shift(p, s, throttle)
            if driveline is None or gear is not s.gear:  # `_shift` returns the old array if no gear changes
                driveline = _driveline(p, gear)
            s = CarlaState(*self._roll(p, s, driveline, throttle, brake), gear, target, since_shift, throttle, brake)
        is_held = (s.brake > ZERO) & (s.speed < p.standstill)
        if np.count_nonzero(is_held):
            s.speed[is_held] = s.wheel_speed[is_held] = ZERO
        return s

    def _roll(
        self, p: _Prepared, s: CarlaState, driveline: tuple[FloatArray, ...], throttle: FloatArray, brake: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Engine, clutch, wheels, tyres and body over one substep; returns the speeds of vehicle [m/s], wheels and
        engine [rad/s].

        I_e dw_e/dt = throttle T(w_e) - c_e w_e - k_c (w_e - G w_w)
        I_w dw_w/dt = G k_c (w_e - G w_w) - d w_w - T_brake - r F
        m dv/dt = F - D v |v| - m g sin

        Index e is the engine, w the wheels; G is the gear ratio, k_c the clutch strength, c_e and d are damping rates,
        D is the air drag. The tyre force F is explicit. It may end the slip within a step but never reverse it, so the
        slip cannot oscillate.
        """
        clutch, clutch_times_ratio, clutch_at_wheel, engine_without_throttle, damping_by_throttle = driveline
        engine = engine_without_throttle + damping_by_throttle * throttle + clutch
        wheel = p.wheel_inertia + p.wheel_damping + clutch_at_wheel * (ONE - clutch / engine)
        # Coefficients of a tyre step for the speeds (of a wheel, at its rim), for torques and for the tyre force:
        engine_share = p.engine_inertia / engine
        engine_gain = throttle * self._torque(p, s.engine_speed) / engine
        rim_by_torque = p.radius / wheel
        rim_share, rim_by_engine = p.wheel_inertia / wheel, clutch_times_ratio * rim_by_torque
        rim_loss = brake * p.brake_torque * rim_by_torque
        rim_by_force = p.radius * rim_by_torque
        speed_loss = p.speed_by_force * p.air_drag * s.speed * s.speed + p.speed_by_slope
        slip_by_force = rim_by_force + p.speed_by_force
        engine_by_rim = clutch_times_ratio / (engine * p.radius)

        speed, rim, engine_speed = s.speed, p.radius * s.wheel_speed, s.engine_speed
        for _ in range(TYRE_STEPS):
            free_engine_speed = engine_share * engine_speed + engine_gain
            free_rim = rim_share * rim + rim_by_engine * free_engine_speed - rim_loss
            slip_end_force = (free_rim - speed) / slip_by_force
            force = self._tyre_force(p, speed, rim)
            force = np.minimum(np.maximum(force, np.minimum(slip_end_force, ZERO)), np.maximum(slip_end_force, ZERO))
            rim = np.maximum(free_rim - rim_by_force * force, ZERO)
            engine_speed = np.minimum(free_engine_speed + engine_by_rim * rim, p.engine_limit)
            speed = np.maximum(speed + p.speed_by_force * force - speed_loss, ZERO)
        return speed, rim / p.radius, engine_speed

    def _shift(self, p: _Prepared, s: CarlaState, throttle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Automatic gearbox: gear, target gear, time since the last shift began [s]; in a shift the gear is neutral."""
        is_ready, speed_share = s.since_shift >= self.shift_latency, s.engine_speed / p.engine_limit
        sets_off = (s.gear <= NEUTRAL) & (s.gear == s.target_gear) & (throttle > ZERO)
        up = sets_off | is_ready & (speed_share > self.shift_up) & (s.gear > NEUTRAL) & (s.gear < TOP_GEAR)
        down = is_ready & (speed_share < self.shift_down) & (s.gear > FIRST_GEAR)
        target = s.target_gear + up - down
        since_shift = np.where(up | down, ZERO, s.since_shift + p.step)
        gear = np.where((target == s.gear) | (since_shift >= p.shift_time - TIME_ROUNDING), target, NEUTRAL)
        return gear if np.count_nonzero(gear != s.gear) else s.gear, target, since_shift

    def _tyre_force(self, p: _Prepared, speed: FloatArray, rim: FloatArray) -> FloatArray:
        """Longitudinal force of the tyres [N] (`PxVehicleComputeTireForceDefault` without lateral slip).

        With slip = (rim - speed) / (max(rim, speed) + offset) and K = C |slip| / (mu load):
        F = mu load (K - K^2 / 3 + K^3 / 27) = mu load (1 - (1 - K / 3)^3) up to K = 3, mu load beyond.
        """
        slip_speed, denominator = rim - speed, np.maximum(rim, speed) + self.slip_offset
        root = np.maximum(denominator - p.slip_stiffness * np.abs(slip_speed), ZERO) / denominator
        force: FloatArray = np.copysign(p.grip - p.grip * root * root * root, slip_speed)
        return force

    def _torque(self, p: _Prepared, engine_speed: FloatArray) -> FloatArray:
        """Engine torque at full throttle [N m]: linear between the points of the curve."""
        speed_share = engine_speed / p.engine_limit
        rising_line = TORQUE_IDLE + TORQUE_RISE * speed_share
        falling_line = TORQUE_PEAK - TORQUE_FALL * (speed_share - PEAK_SPEED)
        torque: FloatArray = self.engine_torque * np.minimum(rising_line, falling_line)
        return torque


def _pedal_position(command: FloatArray, pedal: FloatArray, fall: float, rise: float) -> FloatArray:
    """Position of a pedal that follows its command, with the largest fall and rise."""
    return pedal + np.minimum(np.maximum(command - pedal, -fall), rise)
