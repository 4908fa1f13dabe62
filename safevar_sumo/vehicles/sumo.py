"""A vehicle with the parameters of a SUMO vType, and with delays of its sensors and actuators."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.records import BoolArray, Command, FloatArray
from safevar_sumo.vehicles.base import LEVEL, Characteristics, SensingVehicle, Slope, SumoType, pedals_on_slope
from safevar_sumo.vehicles.sensors import delay_signal, extend_history, start_history


class _Prepared(NamedTuple):
    """Constants of a run, SI, shape (N,)."""

    step: float
    mass: FloatArray
    accel: FloatArray
    decel: FloatArray
    grip: float | FloatArray
    max_speed: FloatArray
    actuator_lag: FloatArray
    sensor_range: FloatArray
    latency: FloatArray
    brake_delay: FloatArray
    brake_gain: FloatArray
    back: float | FloatArray  # deceleration by the slope


class SumoState(NamedTuple):
    """State of N vehicles: speed [m/s], acceleration by the wheels [m/s^2], actuator positions [-], and histories of
    delayed signals.
    """

    speed: FloatArray
    acceleration: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    seen: FloatArray | None
    brake_commands: FloatArray


class SumoVehicle(SensingVehicle, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A SUMO vehicle type: greatest accelerations, top speed, and delays of sensors and actuators.

    Parameters
    ----------
    reference_mass
        Mass to which accel and decel refer [kg]; at another mass the forces stay the same.
    tyre_friction
        Friction coefficient of the tyres on a dry road [-]; no acceleration exceeds this coefficient times g.
    """

    UNITS = {
        "mass": "kg",
        "accel": "m/s^2",
        "decel": "m/s^2",
        "maxSpeed": "m/s",
        "tau": "s",
        "sensorRange": "m",
        "reactionTime": "s",
        "brakeDelay": "s",
        "brakeGain": "-",
    }

    reference_mass: Annotated[float, Meta(gt=0)] = 1500.0
    tyre_friction: Annotated[float, Meta(gt=0)] = 0.9

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        wet: bool | BoolArray = False,
    ) -> _Prepared:
        c = characteristics
        mass_ratio = self.reference_mass / c["mass"]
        return _Prepared(
            step=step,
            mass=c["mass"],
            accel=c["accel"] * mass_ratio,
            decel=c["decel"] * mass_ratio,
            grip=self.tyre_friction * road_friction * slope.down,
            max_speed=c["maxSpeed"],
            actuator_lag=c["tau"],
            sensor_range=c["sensorRange"],
            latency=c["reactionTime"],
            brake_delay=c["brakeDelay"],
            brake_gain=c["brakeGain"],
            back=slope.back,
        )

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        p = prepared
        return SumoType(
            mass=p.mass,
            accel=np.minimum(p.accel, p.grip),
            decel=np.minimum(p.decel, p.grip),
            max_speed=p.max_speed,
            tau=p.actuator_lag,
        )

    def at_rest(self, prepared: _Prepared) -> SumoState:
        zeros = np.zeros_like(prepared.mass)
        commands = start_history(float(np.max(prepared.brake_delay)), prepared.step, zeros)
        return SumoState(zeros, zeros, zeros, zeros, zeros + 1, None, commands)

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> SumoState:
        p, rest = prepared, self.at_rest(prepared)
        throttle, brake = pedals_on_slope(p.back, p.accel, p.brake_gain * p.decel)
        return rest._replace(
            speed=speed,
            acceleration=rest.acceleration + p.back,
            throttle=throttle,
            brake=brake,
            brake_commands=rest.brake_commands + brake,
        )

    def advance(self, prepared: _Prepared, state: SumoState, command: Command) -> SumoState:
        """The wheels follow the pedals with the actuator lag T: dv/dt = a - g sin(slope), da/dt = (target - a) / T."""
        p = prepared
        commands = extend_history(state.brake_commands, command.brake)
        brake = delay_signal(commands, p.brake_delay, p.step)
        target = np.where(brake > 0, -brake * p.brake_gain * p.decel, command.throttle * p.accel)
        target = np.minimum(np.maximum(target, -p.grip), p.grip)
        acceleration = state.acceleration + (target - state.acceleration) * (p.step / (p.actuator_lag + p.step))
        # Braking ends a positive acceleration at once, without lag.
        acceleration = np.where(brake > 0, np.minimum(acceleration, 0.0), acceleration)
        speed = np.minimum(
            np.maximum(state.speed + (acceleration - p.back) * p.step, 0.0), np.maximum(p.max_speed, state.speed)
        )
        return state._replace(
            speed=speed,
            acceleration=(speed - state.speed) / p.step + p.back,
            throttle=np.where(brake > 0, 0.0, command.throttle),
            brake=brake,
            brake_commands=commands,
        )
